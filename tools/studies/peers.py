"""Rate and distortion of our files beside the formats of other programs, for one trained model.

    python -m tools.studies.peers runs/bonsai/model.hyrf data/bonsai
    python -m tools.studies.peers runs/bonsai/model.hyrf data/bonsai --ours small.hyrf medium.hyrf large.hyrf

Other formats hold explicit Gaussians, so the model is baked first: geometry as it decodes, colour as spherical
harmonics fitted to what the training cameras see. Each format then writes its real files (see `peers_formats.py`),
which its own program reads back. All are rendered by our rasteriser and scored on the held-out photos.

The peers are given an advantage wherever there was a choice: the background sphere, which their formats cannot hold, is
rendered for them from our model and its bytes are not counted; opacities and scales are cut where nobody sees it;
Gaussians come in Morton order; and the faintest are left out in some of their settings, in none of ours.
What they are not given: the Gaussians were trained with our fields, not with spherical harmonics of their own, so
`drop, baked` says what a format loses and `drop, trained` says what leaving the hybrid model costs as well.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import cycle, product
from pathlib import Path
from statistics import fmean

import numpy as np
import torch
from torch import Tensor

import hyrfpack
from hyrfpack.evaluate.figures import blank_figure, save_figure
from hyrfpack.evaluate.metrics import psnr, ssim, to_8bit
from hyrfpack.format.codec import PROFILES
from hyrfpack.model import Geometry, HybridModel
from hyrfpack.model.gaussians import logit
from hyrfpack.ops.poses import camera_center
from hyrfpack.ops.rasterize import rasterize
from hyrfpack.ops.rasterize.cull import frustum_cull
from hyrfpack.render import RenderSettings, render
from hyrfpack.scene import Camera, View
from hyrfpack.splats.harmonics import harmonics_basis
from tools.studies.peers_formats import NotAvailable, Png, RoundTrip, Sog, Splats, SplatTransform, Spz, morton_order

# Our settings: profile -> variants of its settings. A profile that is not named here is taken with its defaults.
OURS: dict[str, list[dict]] = {
    "paper": [
        {},
        {"color": (1, 128), "scale": (1, 32), "opacity": (1, 16)},
        {"color": (3, 256), "scale": (2, 128), "opacity": (2, 32)},
    ],
    "compact": [{}, *({"distortion": value} for value in (2e-6, 8e-6, 8e-5, 3e-4))],
}
REFERENCES = ("raw",)  # profiles that do not compress

# Settings of the peers.
DEGREES = (0, 1, 2, 3)
RIDGES = (0.05, 0.5)  # of the fitted harmonics: more costs colour and makes them easier to quantise and to cluster
MIN_OPACITIES = (0.0, 0.15)
SPZ_LENGTHS = (1.0, 1 / 4)
SOG_CLUSTERS = (1024, 4096)
PNG_CLUSTERS = (1024, 4096)

UNSEEN = 0.01  # weight of a training camera that a Gaussian sends no light to
BLOCK = 32768  # Gaussians fitted at once
LOGIT_TAIL = 7.0  # opacities beyond are cut, 1e-3 from 1; the rasteriser cuts alpha at 0.99
LOG_SCALE_LEAST = -10.0  # of local units, far below a pixel; the least that SPZ can hold, too
COLORS = ("#d93025", "#8430ce", "#1a73e8", "#188038", "#e37400", "#12858d", "#5f6368")  # of formats, as they come


@dataclass(frozen=True)
class Row:
    """One file, measured.

    Attributes:
        format: whose file; ours are named by profile.
        setting: with which settings.
        bytes: on disk.
        gaussians: in the file.
        bits: per Gaussian of the trained model.
        psnr, ssim: against the held-out photos.
        drop_hybrid: dB of `psnr` lost against the trained model.
        drop_baked: the same against the baked model of the same degree and the least ridge; None for our files.
        likeness: PSNR against the trained model's own pictures, dB.
    """

    format: str
    setting: str
    bytes: int
    gaussians: int
    bits: float
    psnr: float
    ssim: float
    drop_hybrid: float
    drop_baked: float | None
    likeness: float


@torch.no_grad()
def bake(model: HybridModel, cameras: Sequence[Camera]) -> dict[tuple[int, float], Splats]:
    """The model as explicit Gaussians in local units and Morton order, by the degree of the harmonics and the ridge.

    Colours minimise, for each Gaussian over cameras v at directions d_v,

        sum_v w_v |0.5 + sum_i k_i Y_i(d_v) - color(d_v)|^2 + ridge sum_{i > 0} |k_i|^2

    with w_v = UNSEEN + the light that the Gaussian sends to picture v, in units of its mean over pictures. Only the
    normal equations are kept, for BLOCK Gaussians at a time: 2 kB each.
    """
    geometry, positions = model.decode_geometry(), model.gaussians.positions.detach()
    poses = [torch.as_tensor(model.config.frame.local_pose(camera), dtype=torch.float32) for camera in cameras]
    light = torch.stack([_light(positions, geometry, *camera) for camera in zip(cameras, poses, strict=True)])
    weights = UNSEEN + light / light.mean(0).clamp_min(1e-9)
    fitted: dict[tuple[int, float], list[Tensor]] = {variant: [] for variant in product(DEGREES, RIDGES)}
    for index in torch.arange(len(positions)).split(BLOCK):
        normal = torch.zeros(len(index), 16, 16, dtype=torch.float64)
        target = torch.zeros(len(index), 16, 3, dtype=torch.float64)
        for row, pose in zip(weights, poses, strict=True):
            viewpoint = camera_center(pose)
            directions = torch.nn.functional.normalize(positions[index] - viewpoint, dim=-1, eps=1e-12)
            basis = harmonics_basis(directions.double())
            weighted = (row[index, None] * basis)[..., None]
            normal += weighted * basis[:, None]
            target += weighted * (model.decode_colors(viewpoint, index).double() - 0.5)[:, None]
        penalty = (torch.arange(16) > 0).double().diag()
        for (degree, ridge), parts in fitted.items():
            terms = (degree + 1) ** 2
            ridged = (normal + ridge * penalty)[:, :terms, :terms]
            parts.append(torch.cholesky_solve(target[:, :terms], torch.linalg.cholesky(ridged)).float())
    quats = torch.nn.functional.normalize(geometry.quats, dim=-1)
    quats = torch.where(quats[:, :1] < 0, -quats, quats)
    shared = (
        positions.numpy(),
        geometry.scales.log().clamp_min(LOG_SCALE_LEAST).numpy(),
        quats.numpy(),
        logit(geometry.opacities).clamp_max(LOGIT_TAIL).numpy(),
    )
    order = morton_order(shared[0])
    return {variant: Splats(*shared, torch.cat(parts).numpy())[order] for variant, parts in fitted.items()}


def _light(positions: Tensor, geometry: Geometry, camera: Camera, pose: Tensor) -> Tensor:
    """(N,) the light that each Gaussian sends to a picture: the sum over pixels of T alpha, its colour's gradient."""
    size = camera.intrinsics, camera.width, camera.height
    with torch.enable_grad():
        colors = torch.ones(len(positions), 3, requires_grad=True)
        raster = rasterize(positions, geometry.quats, geometry.scales, geometry.opacities, colors, pose, *size)
        (gradient,) = torch.autograd.grad(raster.rgb[..., 0].sum(), colors)
    return gradient[:, 0]


@dataclass(frozen=True)
class HeldOut:
    """A held-out view with all that is the same for every contender.

    Attributes:
        photo: (H, W, 3), and mask (H, W) bool or None.
        behind: (H, W, 3) the trained model's background.
        trained: (H, W, 3) the trained model's picture, 8 bits.
    """

    camera: Camera
    photo: Tensor
    mask: Tensor | None
    behind: Tensor
    trained: Tensor


@torch.no_grad()
def held_out(model: HybridModel, views: Sequence[View]) -> list[HeldOut]:
    """Load the photos and render what all contenders share. Views without a pixel to score are left out."""
    decoded, solid = model.decode(), np.array(model.config.solid, np.float32)
    made = []
    for view in views:
        picture = view.load()
        mask = None if picture.mask is None else torch.from_numpy(picture.mask)
        if mask is not None and not mask.any():
            continue
        trained = to_8bit(render(model, view.camera, decoded=decoded).rgb)
        photo = torch.from_numpy(picture.composite(solid))
        made.append(HeldOut(view.camera, photo, mask, _background(model, view.camera), trained))
    return made


def _background(model: HybridModel, camera: Camera) -> Tensor:
    """(H, W, 3) what lies behind the Gaussians, at every pixel."""
    if not model.config.background:
        return torch.tensor(model.config.solid).expand(camera.height, camera.width, 3)
    pose = torch.as_tensor(model.config.frame.local_pose(camera), dtype=torch.float32)
    rows, columns = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
    points = torch.stack((columns, rows), -1).reshape(-1, 2) + 0.5
    return model.decode_background(points, camera.intrinsics, pose).reshape(camera.height, camera.width, 3)


@torch.no_grad()
def draw(splats: Splats, view: HeldOut, model: HybridModel) -> Tensor:
    """(H, W, 3) explicit Gaussians in the local units of `model`, as `hyrfpack.render` draws the model's own."""
    settings, camera = RenderSettings(), view.camera
    pose = torch.as_tensor(model.config.frame.local_pose(camera), dtype=torch.float32)
    size = camera.intrinsics, camera.width, camera.height
    index = frustum_cull(torch.from_numpy(splats.positions), pose, *size, settings.near, settings.cull_tolerance)
    positions, log_scales, quats, opacity_logits, harmonics = (
        torch.from_numpy(np.ascontiguousarray(values, np.float32))[index] for values in vars(splats).values()
    )
    directions = torch.nn.functional.normalize(positions - camera_center(pose), dim=-1, eps=1e-12)
    basis = harmonics_basis(directions)[:, : harmonics.shape[1]]
    raster = rasterize(
        positions,
        quats,
        log_scales.exp(),
        opacity_logits.sigmoid(),
        (torch.einsum("nk,nkc->nc", basis, harmonics) + 0.5).clamp_min(0),
        pose,
        *size,
        near=settings.near,
        antialiased=model.config.antialiased,
        transmittance_min=settings.transmittance_min,
    )
    return raster.rgb + raster.transmittance[..., None] * view.behind


def score(pictures: Iterable[Tensor], views: Sequence[HeldOut]) -> tuple[float, float, float]:
    """PSNR and SSIM against the photos and PSNR against the trained model's pictures, means over views."""
    scores = []
    for picture, view in zip(map(to_8bit, pictures), views, strict=True):
        against = psnr(picture, view.photo, view.mask), ssim(picture, view.photo, view.mask)
        scores.append((*against, psnr(picture, view.trained, view.mask)))
    first, second, third = map(fmean, zip(*scores, strict=True))
    return first, second, third


@dataclass(frozen=True)
class Setting:
    """A point on a peer's curve.

    Attributes:
        name: what `run` does.
        degree, ridge: of the baked model.
        min_opacity: fainter Gaussians are left out.
        run: writes the files and reads them back.
    """

    format: str
    name: str
    degree: int
    ridge: float
    min_opacity: float
    run: RoundTrip

    def __str__(self) -> str:
        ridge = f"ridge {self.ridge:g}" if self.degree else ""
        pruned = f"opacity >= {self.min_opacity:g}" if self.min_opacity else ""
        return ", ".join(part for part in (f"degree {self.degree}", self.name, ridge, pruned) if part)


def settings_of(format: str, flat: dict[str, RoundTrip], full: dict[str, RoundTrip]) -> Iterator[Setting]:
    """All settings of a format: what runs for degree 0, for higher degrees with every ridge, and both pruned."""
    for degree, ridge, least in product(DEGREES, RIDGES, MIN_OPACITIES):
        if degree or ridge == RIDGES[0]:
            for name, run in (full if degree else flat).items():
                yield Setting(format, name, degree, ridge, least, run)


def spz_settings(program: SplatTransform) -> Iterator[Setting]:
    """All settings of SPZ."""
    runs = {f"lengths x {length:g}": Spz(program, length).round_trip for length in SPZ_LENGTHS}
    return settings_of("SPZ", runs, runs)


def sog_settings(program: SplatTransform) -> Iterator[Setting]:
    """All settings of SOG."""
    runs = {f"{clusters:,} clusters": Sog(program, clusters).round_trip for clusters in SOG_CLUSTERS}
    yield from settings_of("SOG", {"": Sog(program).round_trip}, runs)
    for degree in DEGREES[1:]:  # slow, and far right on the curve: one each
        yield Setting("SOG", "palette as it comes", degree, RIDGES[0], 0.0, Sog(program).round_trip)


def png_settings() -> Iterator[Setting]:
    """All settings of gsplat's PNG."""
    Png.find()
    runs = {f"{clusters:,} clusters": Png(clusters).round_trip for clusters in PNG_CLUSTERS}
    return settings_of("PNG", {"": Png(PNG_CLUSTERS[0]).round_trip}, runs)


def available_settings(formats: Sequence[str], splat_transform: str | None) -> list[Setting]:
    """The settings of all formats wanted that can run here; says why others cannot."""
    makers: dict[str, Callable[[], Iterator[Setting]]] = {
        "SPZ": lambda: spz_settings(SplatTransform.find(splat_transform)),
        "SOG": lambda: sog_settings(SplatTransform.find(splat_transform)),
        "PNG": png_settings,
    }
    settings: list[Setting] = []
    for name in formats:
        try:
            settings += makers[name]()
        except NotAvailable as reason:
            print(f"{name} is left out: {reason}", flush=True)
    return settings


class Measure:
    """Measures files of one trained model."""

    def __init__(self, model: HybridModel, train: Sequence[View], test: Sequence[View]) -> None:
        self.model = model
        self.views = held_out(model, test)
        self.trained = score([view.trained for view in self.views], self.views)
        self.baked = bake(model, [view.camera for view in train])
        self.baked_psnr = [self.splats(self.baked[degree, RIDGES[0]])[0] for degree in DEGREES]

    def splats(self, splats: Splats) -> tuple[float, float, float]:
        """Scores of explicit Gaussians."""
        return score((draw(splats, view, self.model) for view in self.views), self.views)

    def _row(
        self, format: str, setting: str, size: int, count: int, scores: Sequence[float], degree: int | None = None
    ) -> Row:
        quality, structure, likeness = scores
        drop_baked = None if degree is None else self.baked_psnr[degree] - quality
        bits, drop = 8 * size / len(self.model), self.trained[0] - quality
        return Row(format, setting, size, count, bits, quality, structure, drop, drop_baked, likeness)

    def peer(self, setting: Setting) -> Row:
        """Write, read back, draw and score a peer's file."""
        baked = self.baked[setting.degree, setting.ridge]
        kept = baked[baked.opacity_logits >= float(logit(torch.tensor(setting.min_opacity)))]
        with tempfile.TemporaryDirectory() as folder:
            size, read = setting.run(kept, Path(folder))
        return self._row(setting.format, str(setting), size, len(read), self.splats(read), setting.degree)

    def ours(self, path: Path, setting: str) -> Row:
        """Load, render and score a `.hyrf` file."""
        model, profile = hyrfpack.load(path), hyrfpack.describe(path)["profile"]
        with torch.no_grad():
            decoded = model.decode()
            scores = score((render(model, view.camera, decoded=decoded).rgb for view in self.views), self.views)
        return self._row(f"hyrfpack {profile}", setting, path.stat().st_size, len(model), scores)


def our_files(trained: Path, given: Sequence[Path], folder: Path) -> Iterator[tuple[Path, str]]:
    """Files of all profiles, made in `folder`, and those given, each with what it is called."""
    for profile in PROFILES:
        for number, settings in enumerate(OURS.get(profile, [{}])):
            if profile not in REFERENCES:
                path = folder / f"{profile}-{number}.hyrf"
                hyrfpack.compress(trained, path, profile, **settings)
                yield path, ", ".join(f"{name} {value}" for name, value in settings.items()) or "default"
    for path in given:
        yield path, path.stem


def by_format(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """The rows of each format, in the order in which formats come."""
    return {name: [row for row in rows if row.format == name] for name in dict.fromkeys(row.format for row in rows)}


def front(rows: Sequence[Row]) -> list[Row]:
    """The rows that no smaller row equals in PSNR, from the smallest."""
    best: list[Row] = []
    for row in sorted(rows, key=lambda row: (row.bytes, -row.psnr)):
        if not best or row.psnr > best[-1].psnr:
            best.append(row)
    return best


def table(rows: Sequence[Row], trained: int) -> str:
    """The rows as Markdown; `trained` is the number of Gaussians of the trained model."""
    lines = [
        "| format | setting | Gaussians | bytes | bits/Gaussian "
        "| PSNR | SSIM | drop, trained | drop, baked | likeness |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        baked = "" if row.drop_baked is None else f"{row.drop_baked:.2f}"
        lines.append(
            f"| {row.format} | {row.setting} | {row.gaussians / trained:.0%} | {row.bytes:,} | {row.bits:.1f} | "
            f"{row.psnr:.2f} | {row.ssim:.3f} | {row.drop_hybrid:.2f} | {baked} | {row.likeness:.1f} |"
        )
    return "\n".join(lines)


def plot(rows: Sequence[Row], trained: float, baked: float, title: str, path: Path) -> None:
    """Draw PSNR against bytes: each format's front as a line, its other settings faint."""
    figure = blank_figure(8, 5.5)
    axes = figure.subplots()
    for (name, here), color in zip(by_format(rows).items(), cycle(COLORS), strict=False):
        line = front(here)
        axes.scatter(
            [row.bytes for row in here], [row.psnr for row in here], s=10, color=color, alpha=0.3, linewidths=0
        )
        axes.plot([row.bytes for row in line], [row.psnr for row in line], "o-", color=color, markersize=4, label=name)
    for value, label, style in ((trained, "trained model", "-"), (baked, "baked, not compressed", "--")):
        axes.axhline(value, color="#5f6368", linewidth=0.8, linestyle=style, label=label)
    axes.set(xscale="log", xlabel="bytes", ylabel="PSNR on held-out photos (dB)")
    axes.set_title(title, fontsize=10, loc="left")
    axes.grid(alpha=0.3, which="both")
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False)
    save_figure(path, figure, format="png", metadata={"Software": None})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=Path, help="a trained model.hyrf")
    parser.add_argument("data", type=Path, help="the folder it was trained on")
    parser.add_argument("--ours", type=Path, nargs="*", default=[], help="compressed .hyrf files to plot as ours, too")
    parser.add_argument("--formats", nargs="*", choices=("SPZ", "SOG", "PNG"), default=["SPZ", "SOG", "PNG"])
    parser.add_argument("--splat-transform", help="the program (default: on the PATH, or through npx)")
    parser.add_argument("--out", type=Path, help="folder for results (runs/peers/<name of the data folder>)")
    args = parser.parse_args()
    out = args.out or Path("runs/peers") / args.data.name
    out.mkdir(parents=True, exist_ok=True)
    settings = available_settings(args.formats, args.splat_transform)
    scene, model = hyrfpack.load_scene(args.data), hyrfpack.load(args.model)
    measure = Measure(model, scene.train, scene.test)
    baked = ", ".join(f"degree {degree} {quality:.2f}" for degree, quality in enumerate(measure.baked_psnr))
    print(
        f"{args.data.name}: {len(model):,} Gaussians; PSNR trained {measure.trained[0]:.2f}; baked {baked}", flush=True
    )
    with tempfile.TemporaryDirectory() as folder:
        rows = [measure.ours(*file) for file in our_files(args.model, args.ours, Path(folder))]
    for number, setting in enumerate(settings):
        rows.append(measure.peer(setting))
        print(f"{number + 1}/{len(settings)} {table(rows[-1:], len(model)).splitlines()[-1]}", flush=True)
    best = [row for here in by_format(rows).values() for row in front(here)]
    print(f"\nThe settings that no smaller file of the same format equals:\n\n{table(best, len(model))}")
    report = {"trained_psnr": measure.trained[0], "baked_psnr": measure.baked_psnr, "rows": list(map(asdict, rows))}
    (out / "peers.json").write_text(json.dumps(report, indent=1))
    title = f"{args.data.name}: {len(model):,} Gaussians (peers without the bytes of the background)"
    plot(rows, measure.trained[0], max(measure.baked_psnr), title, out / "peers.png")
    print(f"\nwrote {out / 'peers.json'} and {out / 'peers.png'}")


if __name__ == "__main__":
    main()

"""Rate and distortion of our files beside the formats of other programs, for one trained model.

    python -m tools.studies.peers runs/bonsai/model.hyrf data/bonsai
    python -m tools.studies.peers runs/bonsai/model.hyrf data/bonsai --ours small.hyrf medium.hyrf large.hyrf

Other formats hold explicit Gaussians, so the model is baked first, as `hyrfpack export` does it. SPZ and SOG are then
what it writes (our SPZ keeps 6 bits of a harmonic, others 4 or 5: larger files, closer to the model); gsplat's PNG is
what gsplat writes (see `gsplat_png.py`). Every file is read back, drawn by our rasteriser and scored on the held-out
photos.

The peers are given an advantage wherever there was a choice: the background sphere, which their formats cannot hold, is
rendered for them from our model and its bytes are not counted; Gaussians come in Morton order; and the faintest are
left out in some of their settings, in none of ours. What they are not given: the Gaussians were trained with our
fields, not with spherical harmonics of their own, so `drop, baked` says what a format loses and `drop, trained` says
what leaving the hybrid model costs as well.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from itertools import cycle, product
from pathlib import Path
from statistics import fmean

import numpy as np
import torch
from torch import Tensor

import hyrfpack
from hyrfpack.choices import SPZ_VERSIONS
from hyrfpack.evaluate.figures import blank_figure, save_figure
from hyrfpack.evaluate.metrics import psnr, ssim, to_8bit
from hyrfpack.export.bake import bake
from hyrfpack.export.kinds import select_splats
from hyrfpack.export.source import Source
from hyrfpack.format.codec import PROFILES
from hyrfpack.model import HybridModel
from hyrfpack.render import render_view
from hyrfpack.scene import Camera, View
from hyrfpack.splats.draw import Drawable, draw
from hyrfpack.splats.formats.hints import NO_HINTS, Hints
from hyrfpack.splats.splats import Splats
from hyrfpack.splats.table import FORMATS
from tools.studies import gsplat_png

# Our settings: profile -> variants of its settings. A profile that is not named here is taken with its defaults.
OURS: dict[str, list[dict]] = {
    "paper": [
        {},
        {"color": (1, 128), "scale": (1, 32), "opacity": (1, 16)},
        {"color": (3, 256), "scale": (2, 128), "opacity": (2, 32)},
    ],
    "compact": [{}, *({"noise": noise} for noise in (2e-6, 8e-6, 8e-5, 3e-4))],
}
REFERENCES = ("raw",)  # profiles that do not compress

# Settings of the peers.
PEERS = ("SPZ", "SOG", "PNG")
DEGREES = (0, 1, 2, 3)
MIN_OPACITIES = (0.0, 0.05, 0.15)
PNG_CLUSTERS = (1024, 4096)

RoundTrip = Callable[[Splats], tuple[int, Splats]]
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
        drop_baked: the same against the baked model of the same degree; None for our files.
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
        trained = to_8bit(render_view(model, view.camera, decoded=decoded).rgb)
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


def picture_of(splats: Drawable, view: HeldOut) -> Tensor:
    """(H, W, 3) splats over the trained model's background."""
    raster = draw(splats, view.camera)
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
        peer: one of PEERS.
        name: what `run` does.
        degree: of the baked model.
        min_opacity: fainter Gaussians are left out.
        run: writes the files and reads them back.
    """

    peer: str
    name: str
    degree: int
    min_opacity: float
    run: RoundTrip

    def __str__(self) -> str:
        pruned = f"opacity >= {self.min_opacity:g}" if self.min_opacity else ""
        return ", ".join(part for part in (f"degree {self.degree}", self.name, pruned) if part)


def through(ending: str, hints: Hints, splats: Splats) -> tuple[int, Splats]:
    """Bytes of a file of ours, and the Gaussians read back from it."""
    data = FORMATS[ending].encode(splats, hints)
    return len(data), FORMATS[ending].decode(data, ending)


def runs_of(peer: str, degree: int) -> dict[str, RoundTrip]:
    """What can be set in a peer's files, by name."""
    if peer == "SPZ":
        return {f"version {v}": partial(through, ".spz", Hints(spz_version=v)) for v in SPZ_VERSIONS}
    if peer == "SOG":
        return {"": partial(through, ".sog", NO_HINTS)}
    if not degree:  # there is nothing to cluster
        return {"": partial(gsplat_png.round_trip, clusters=1)}
    return {f"{count:,} clusters": partial(gsplat_png.round_trip, clusters=count) for count in PNG_CLUSTERS}


def settings_of(peer: str) -> Iterator[Setting]:
    """All settings of a peer."""
    for degree, least in product(DEGREES, MIN_OPACITIES):
        for name, run in runs_of(peer, degree).items():
            yield Setting(peer, name, degree, least, run)


class Measure:
    """Measures files of one trained model."""

    def __init__(self, source: Source, test: Sequence[View]) -> None:
        self.model = source.model
        self.views = held_out(self.model, test)
        self.trained = score([view.trained for view in self.views], self.views)
        baked = bake(self.model, source.fit_cameras, DEGREES)
        self.baked = {degree: gsplat_png.in_morton_order(splats) for degree, splats in baked.items()}
        self.baked_psnr = [self.splats(self.baked[degree])[0] for degree in DEGREES]

    def splats(self, splats: Splats) -> tuple[float, float, float]:
        """Scores of explicit Gaussians."""
        drawable = Drawable.from_splats(splats, self.model.config.frame)
        return score((picture_of(drawable, view) for view in self.views), self.views)

    def _row(
        self, whose: str, setting: str, size: int, count: int, scores: Sequence[float], degree: int | None = None
    ) -> Row:
        quality, structure, likeness = scores
        drop_baked = None if degree is None else self.baked_psnr[degree] - quality
        bits, drop = 8 * size / len(self.model), self.trained[0] - quality
        return Row(whose, setting, size, count, bits, quality, structure, drop, drop_baked, likeness)

    def peer(self, setting: Setting) -> Row:
        """Write, read back, draw and score a peer's file."""
        size, read = setting.run(select_splats(self.baked[setting.degree], None, setting.min_opacity))
        return self._row(setting.peer, str(setting), size, len(read), self.splats(read), setting.degree)

    def ours(self, path: Path, setting: str) -> Row:
        """Load, render and score a `.hyrf` file."""
        model, profile = hyrfpack.load_model(path), hyrfpack.describe_file(path)["profile"]
        with torch.no_grad():
            decoded = model.decode()
            scores = score((render_view(model, view.camera, decoded=decoded).rgb for view in self.views), self.views)
        return self._row(f"hyrfpack {profile}", setting, path.stat().st_size, len(model), scores)


def our_files(trained: Path, given: Sequence[Path], folder: Path) -> Iterator[tuple[Path, str]]:
    """Files of all profiles, made in `folder`, and those given, each with what it is called."""
    for profile in PROFILES:
        for number, settings in enumerate(OURS.get(profile, [{}])):
            if profile not in REFERENCES:
                path = folder / f"{profile}-{number}.hyrf"
                hyrfpack.compress_model(trained, path, profile, **settings)
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
    parser.add_argument("--formats", nargs="*", choices=PEERS, default=PEERS)
    parser.add_argument("--out", type=Path, help="folder for results (runs/peers/<name of the data folder>)")
    args = parser.parse_args()
    out = args.out or Path("runs/peers") / args.data.name
    out.mkdir(parents=True, exist_ok=True)
    peers = list(args.formats)
    if "PNG" in peers and (missing := gsplat_png.missing_packages()):
        peers.remove("PNG")
        print(f"PNG is left out: there is no {', no '.join(missing)}; see tools/studies/gsplat_png.py", flush=True)
    settings = [setting for peer in peers for setting in settings_of(peer)]
    scene = hyrfpack.load_scene(args.data)
    source = Source.read(args.model, scene)
    measure, model = Measure(source, scene.test), source.model
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

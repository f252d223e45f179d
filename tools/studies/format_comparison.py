"""Compare rate and distortion of `.hyrf` files with the formats of other programs, for one trained model.

    python -m tools.studies.format_comparison runs/bonsai/model.hyrf data/bonsai
    python -m tools.studies.format_comparison runs/bonsai/model.hyrf data/bonsai --ours small.hyrf large.hyrf

Other formats store explicit Gaussians, so the model is baked first, as by `hyrfpack export`. hyrfpack writes SPZ and
SOG; its SPZ keeps 6 bits of a harmonic, others 4 or 5, so its files are larger and closer to the model. gsplat writes
its PNG format (see `gsplat_png.py`). Every file is decoded, drawn by hyrfpack's rasteriser and scored on held-out
photos. The table has bytes, bits per Gaussian, PSNR in dB, SSIM, losses in dB, and PSNR against the trained model's
pictures ("PSNR, to the model"). It also writes peers.json and a plot into --out.

Wherever there is a choice, it favours the other formats. They cannot store the background sphere, so it is rendered
from our model and its bytes are not counted; Gaussians come in Morton order; and some of their settings leave out the
faintest Gaussians. One disadvantage remains: the Gaussians were trained with fields, not with spherical harmonics.
Therefore `drop, baked` is the loss of the format alone, and `drop, trained` includes the loss of baking.

The results are in docs/research/compression.md.
"""

from __future__ import annotations

import argparse
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
from hyrfpack.evaluate.figures import make_blank_figure, save_figure
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
from tools.command import run_command
from tools.json_files import write_json
from tools.studies import gsplat_png
from tools.tables import markdown_table

# The settings with which each profile is measured; a profile without an entry uses its defaults.
PROFILE_SETTINGS: dict[str, list[dict]] = {
    "paper": [
        {},
        {"color": (1, 128), "scale": (1, 32), "opacity": (1, 16)},
        {"color": (3, 256), "scale": (2, 128), "opacity": (2, 32)},
    ],
    "compact": [{}, *({"distortion": distortion} for distortion in (2e-6, 8e-6, 8e-5, 3e-4))],
}
UNCOMPRESSED_PROFILES = ("raw",)

# The other formats and their settings.
PEER_FORMATS = ("SPZ", "SOG", "PNG")
SH_DEGREES = (0, 1, 2, 3)
MIN_OPACITIES = (0.0, 0.05, 0.15)
PNG_CLUSTERS = (1024, 4096)

RoundTrip = Callable[[Splats], tuple[int, Splats]]
FORMAT_COLORS = ("#d93025", "#8430ce", "#1a73e8", "#188038", "#e37400", "#12858d", "#5f6368")


@dataclass(frozen=True)
class MeasuredFile:
    """One file and its scores.

    Attributes:
        format: name of the format; for `.hyrf` files with the profile.
        setting: settings of the encoder.
        bytes: size on disk.
        gaussians: number of Gaussians in the file.
        bits: bits per Gaussian of the trained model.
        psnr, ssim: PSNR in dB and SSIM against the held-out photos.
        drop_hybrid: loss of `psnr` in dB against the trained model.
        drop_baked: loss of `psnr` in dB against the baked model of the same degree; None for `.hyrf` files.
        psnr_to_model: PSNR in dB against the trained model's pictures.
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
    psnr_to_model: float


@dataclass(frozen=True)
class HeldOutView:
    """A held-out view with everything that all formats share.

    Attributes:
        camera: the camera.
        photo: (H, W, 3) photo.
        mask: (H, W) bool, the pixels to score, or None.
        background: (H, W, 3) background of the trained model.
        trained: (H, W, 3) picture of the trained model, rounded to 8 bits.
    """

    camera: Camera
    photo: Tensor
    mask: Tensor | None
    background: Tensor
    trained: Tensor


@torch.no_grad()
def prepare_held_out_views(model: HybridModel, views: Sequence[View]) -> list[HeldOutView]:
    """Load the photos and render what all formats share; views without a pixel to score are left out."""
    decoded, solid = model.decode(), np.array(model.config.solid, np.float32)
    held_out_views = []
    for view in views:
        picture = view.load()
        mask = None if picture.mask is None else torch.from_numpy(picture.mask)
        if mask is not None and not mask.any():
            continue
        trained = to_8bit(render_view(model, view.camera, decoded=decoded).rgb)
        photo = torch.from_numpy(picture.composite(solid))
        held_out_views.append(HeldOutView(view.camera, photo, mask, _background(model, view.camera), trained))
    return held_out_views


def _background(model: HybridModel, camera: Camera) -> Tensor:
    """Return (H, W, 3), the background behind the Gaussians at every pixel."""
    if not model.config.background:
        return torch.tensor(model.config.solid).expand(camera.height, camera.width, 3)
    rows, columns = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
    points = torch.stack((columns, rows), -1).reshape(-1, 2) + 0.5
    colors = model.decode_background(points, model.config.frame.local_viewport(camera))
    return colors.reshape(camera.height, camera.width, 3)


def draw_over_background(splats: Drawable, view: HeldOutView) -> Tensor:
    """Draw splats over the trained model's background; return (H, W, 3)."""
    raster = draw(splats, view.camera)
    return raster.rgb + raster.transmittance[..., None] * view.background


def score_pictures(pictures: Iterable[Tensor], views: Sequence[HeldOutView]) -> tuple[float, float, float]:
    """Return PSNR and SSIM against the photos, and PSNR against the trained model's pictures; means over views."""
    scores = []
    for picture, view in zip(map(to_8bit, pictures), views, strict=True):
        photo_scores = psnr(picture, view.photo, view.mask), ssim(picture, view.photo, view.mask)
        scores.append((*photo_scores, psnr(picture, view.trained, view.mask)))
    first, second, third = map(fmean, zip(*scores, strict=True))
    return first, second, third


@dataclass(frozen=True)
class PeerSetting:
    """One setting of another format.

    Attributes:
        peer: one of PEER_FORMATS.
        name: name of the encoder's setting.
        degree: degree of the baked model's harmonics.
        min_opacity: Gaussians with a smaller opacity are left out.
        run: encodes and decodes splats; returns the bytes and the decoded splats.
    """

    peer: str
    name: str
    degree: int
    min_opacity: float
    run: RoundTrip

    def __str__(self) -> str:
        pruned = f"opacity >= {self.min_opacity:g}" if self.min_opacity else ""
        return ", ".join(part for part in (f"degree {self.degree}", self.name, pruned) if part)


def round_trip(ending: str, hints: Hints, splats: Splats) -> tuple[int, Splats]:
    """Encode and decode splats with hyrfpack; return the bytes and the decoded splats."""
    data = FORMATS[ending].encode(splats, hints)
    return len(data), FORMATS[ending].decode(data, ending)


def list_round_trips(peer: str, degree: int) -> dict[str, RoundTrip]:
    """Return the round trips of another format by the name of the encoder's setting."""
    if peer == "SPZ":
        return {f"version {v}": partial(round_trip, ".spz", Hints(spz_version=v)) for v in SPZ_VERSIONS}
    if peer == "SOG":
        return {"": partial(round_trip, ".sog", NO_HINTS)}
    if not degree:  # degree 0 has nothing to cluster
        return {"": partial(gsplat_png.round_trip, clusters=1)}
    return {f"{count:,} clusters": partial(gsplat_png.round_trip, clusters=count) for count in PNG_CLUSTERS}


def iterate_settings(peer: str) -> Iterator[PeerSetting]:
    """Yield all settings of another format."""
    for degree, min_opacity in product(SH_DEGREES, MIN_OPACITIES):
        for name, run in list_round_trips(peer, degree).items():
            yield PeerSetting(peer, name, degree, min_opacity, run)


class Measurements:
    """Scores of files in different formats that store one trained model."""

    def __init__(self, source: Source, test: Sequence[View]) -> None:
        self.model = source.model
        self.views = prepare_held_out_views(self.model, test)
        self.trained = score_pictures([view.trained for view in self.views], self.views)
        baked = bake(self.model, source.fit_cameras, SH_DEGREES)
        self.baked = {degree: gsplat_png.sort_in_morton_order(splats) for degree, splats in baked.items()}
        self.baked_psnr = [self.score_splats(self.baked[degree])[0] for degree in SH_DEGREES]

    def score_splats(self, splats: Splats) -> tuple[float, float, float]:
        """Draw and score explicit Gaussians."""
        drawable = Drawable.from_splats(splats, self.model.config.frame)
        return score_pictures((draw_over_background(drawable, view) for view in self.views), self.views)

    def _make_row(
        self, format_name: str, setting: str, size: int, count: int, scores: Sequence[float], degree: int | None = None
    ) -> MeasuredFile:
        photo_psnr, photo_ssim, psnr_to_model = scores
        drop_baked = None if degree is None else self.baked_psnr[degree] - photo_psnr
        bits, drop = 8 * size / len(self.model), self.trained[0] - photo_psnr
        return MeasuredFile(
            format_name, setting, size, count, bits, photo_psnr, photo_ssim, drop, drop_baked, psnr_to_model
        )

    def measure_peer(self, setting: PeerSetting) -> MeasuredFile:
        """Encode, decode, draw and score a file of another format."""
        size, decoded = setting.run(select_splats(self.baked[setting.degree], None, setting.min_opacity))
        return self._make_row(
            setting.peer, str(setting), size, len(decoded), self.score_splats(decoded), setting.degree
        )

    def measure_own_file(self, path: Path, setting: str) -> MeasuredFile:
        """Load, render and score a `.hyrf` file."""
        model, profile = hyrfpack.load_model(path), hyrfpack.describe_file(path)["profile"]
        with torch.no_grad():
            decoded = model.decode()
            scores = score_pictures(
                (render_view(model, view.camera, decoded=decoded).rgb for view in self.views), self.views
            )
        return self._make_row(f"hyrfpack {profile}", setting, path.stat().st_size, len(model), scores)


def compress_with_profiles(trained: Path, other_files: Sequence[Path], folder: Path) -> Iterator[tuple[Path, str]]:
    """Compress the model with all profiles into `folder`; yield these files and the given ones with their settings."""
    for profile in PROFILES:
        for number, settings in enumerate(PROFILE_SETTINGS.get(profile, [{}])):
            if profile not in UNCOMPRESSED_PROFILES:
                path = folder / f"{profile}-{number}.hyrf"
                if profile == "paper":
                    config = hyrfpack.CompressConfig(profile=profile, paper=hyrfpack.PaperSettings(**settings))
                else:
                    config = hyrfpack.CompressConfig(profile=profile, **settings)
                hyrfpack.compress_model(trained, path, config)
                yield path, ", ".join(f"{name} {value}" for name, value in settings.items()) or "default"
    for path in other_files:
        yield path, path.stem


def group_by_format(rows: Sequence[MeasuredFile]) -> dict[str, list[MeasuredFile]]:
    """Group the rows by format, in order of first appearance."""
    return {name: [row for row in rows if row.format == name] for name in dict.fromkeys(row.format for row in rows)}


def find_pareto_front(rows: Sequence[MeasuredFile]) -> list[MeasuredFile]:
    """Return the rows with a higher PSNR than all smaller files, sorted by bytes."""
    best: list[MeasuredFile] = []
    for row in sorted(rows, key=lambda row: (row.bytes, -row.psnr)):
        if not best or row.psnr > best[-1].psnr:
            best.append(row)
    return best


def format_table(rows: Sequence[MeasuredFile], trained: int) -> str:
    """Format the rows as a Markdown table; `trained` is the number of Gaussians of the trained model."""
    columns = ("format", "setting", "Gaussians", "bytes", "bits/Gaussian", "PSNR", "SSIM")
    table_rows = []
    for row in rows:
        cells = [row.format, row.setting, f"{row.gaussians / trained:.0%}", f"{row.bytes:,}", f"{row.bits:.1f}"]
        cells += [f"{row.psnr:.2f}", f"{row.ssim:.3f}", f"{row.drop_hybrid:.2f}"]
        cells += ["" if row.drop_baked is None else f"{row.drop_baked:.2f}", f"{row.psnr_to_model:.1f}"]
        table_rows.append(cells)
    return markdown_table((*columns, "drop, trained", "drop, baked", "PSNR, to the model"), table_rows)


def plot(rows: Sequence[MeasuredFile], trained: float, baked: float, title: str, path: Path) -> None:
    """Plot PSNR against bytes: the Pareto front of each format as a line, its other settings as faint dots."""
    figure = make_blank_figure(8, 5.5)
    axes = figure.subplots()
    for (name, format_rows), color in zip(group_by_format(rows).items(), cycle(FORMAT_COLORS), strict=False):
        front = find_pareto_front(format_rows)
        axes.scatter(
            [row.bytes for row in format_rows],
            [row.psnr for row in format_rows],
            s=10,
            color=color,
            alpha=0.3,
            linewidths=0,
        )
        axes.plot(
            [row.bytes for row in front],
            [row.psnr for row in front],
            "o-",
            color=color,
            markersize=4,
            label=name,
        )
    for value, label, style in ((trained, "trained model", "-"), (baked, "baked, not compressed", "--")):
        axes.axhline(value, color="#5f6368", linewidth=0.8, linestyle=style, label=label)
    axes.set(xscale="log", xlabel="bytes", ylabel="PSNR on held-out photos (dB)")
    axes.set_title(title, fontsize=10, loc="left")
    axes.grid(alpha=0.3, which="both")
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False)
    save_figure(path, figure, format="png", metadata={"Software": None})


def write_report(path: Path, measure: Measurements, rows: list[MeasuredFile]) -> None:
    """Write the scores of the model and the rows that are measured so far as JSON."""
    report = {"trained_psnr": measure.trained[0], "baked_psnr": measure.baked_psnr, "rows": list(map(asdict, rows))}
    write_json(path, report)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=Path, help="a trained model.hyrf")
    parser.add_argument("data", type=Path, help="the folder it was trained on")
    parser.add_argument("--ours", type=Path, nargs="*", default=[], help="further compressed .hyrf files to measure")
    parser.add_argument("--formats", nargs="*", choices=PEER_FORMATS, default=PEER_FORMATS, help="other formats (all)")
    parser.add_argument("--out", type=Path, help="folder for results (runs/peers/<name of the data folder>)")
    args = parser.parse_args()
    out = args.out or Path("runs/peers") / args.data.name
    out.mkdir(parents=True, exist_ok=True)
    peers = list(args.formats)
    if "PNG" in peers and (missing_packages := gsplat_png.list_missing_packages()):
        peers.remove("PNG")
        print(
            f"PNG is left out: there is no {', no '.join(missing_packages)}; see tools/studies/gsplat_png.py",
            flush=True,
        )
    settings = [setting for peer in peers for setting in iterate_settings(peer)]
    scene = hyrfpack.load_scene(args.data)
    source = Source.read(args.model, scene)
    measure, model = Measurements(source, scene.test), source.model
    baked = ", ".join(f"degree {degree} {quality:.2f}" for degree, quality in enumerate(measure.baked_psnr))
    print(
        f"{args.data.name}: {len(model):,} Gaussians; PSNR trained {measure.trained[0]:.2f}; baked {baked}", flush=True
    )
    with tempfile.TemporaryDirectory() as folder:
        rows = [measure.measure_own_file(*file) for file in compress_with_profiles(args.model, args.ours, Path(folder))]
    for number, setting in enumerate(settings):
        rows.append(measure.measure_peer(setting))
        write_report(out / "peers.json", measure, rows)
        print(f"{number + 1}/{len(settings)} {format_table(rows[-1:], len(model)).splitlines()[-1]}", flush=True)
    best = [row for format_rows in group_by_format(rows).values() for row in find_pareto_front(format_rows)]
    print(f"\nThe settings that no smaller file of the same format equals:\n\n{format_table(best, len(model))}")
    write_report(out / "peers.json", measure, rows)
    title = f"{args.data.name}: {len(model):,} Gaussians (peers without the bytes of the background)"
    plot(rows, measure.trained[0], max(measure.baked_psnr), title, out / "peers.png")
    print(f"\nwrote {out / 'peers.json'} and {out / 'peers.png'}")


if __name__ == "__main__":
    run_command(main)

"""Measure bytes, times and losses of every format to which a model can be exported.

    python -m tools.studies.export_table runs/bonsai/model.hyrf data/bonsai
    python -m tools.studies.export_table runs/bonsai/model.hyrf data/bonsai --degrees 0 1 2 3 --formats ply spz

Colours are fitted at the training cameras. Every file is read by hyrfpack's reader and drawn by hyrfpack's rasteriser
at the held-out views. The table has bytes, seconds of encoding and decoding, and PSNR in dB against the model's
pictures and against the photos. The line above the table has the seconds of baking. `tests/independent` checks that
other programs read the same numbers.

The results are in docs/research/export.md.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np

import hyrfpack
from hyrfpack.choices import DEFAULT_SPZ_VERSION
from hyrfpack.export.background import make_background_splats, render_background_picture
from hyrfpack.export.bake import bake
from hyrfpack.export.kinds import HTML_PAGE
from hyrfpack.export.measure import PsnrScores, measure_psnr
from hyrfpack.export.pages import encode_baked_page
from hyrfpack.export.source import Source
from hyrfpack.splats.formats.hints import Hints
from hyrfpack.splats.splats import Splats, concatenate
from hyrfpack.splats.table import FORMATS
from hyrfpack.web.html import decode_splats_page
from tools.command import run_command
from tools.tables import markdown_row, markdown_table

TaskResult = TypeVar("TaskResult")

TABLE_COLUMNS = ("format", "degree", "bytes", "write (s)", "read (s)", "dB, model", "dB, photos", "checked by")
CHECKED_BY = {
    ".ply": "splat-transform, gsply, three.js",
    ".splat": "splat-transform, three.js",
    ".spz": "splat-transform, gsply, three.js",
    ".spz v3": "splat-transform, gsply, three.js",
    ".sog": "splat-transform, gsply",
    ".glb": "three.js, gltf-validator",
    ".usda": "omniverse-asset-validator, OpenUSD",
    ".usdc": "omniverse-asset-validator, OpenUSD",
    ".usdz": "omniverse-asset-validator, OpenUSD",
    ".html": "Chromium",
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=Path, help="a .hyrf file")
    parser.add_argument("data", type=Path, help="folder of the model's photos")
    parser.add_argument("--degrees", type=int, nargs="+", default=[3], help="degrees of the spherical harmonics (3)")
    parser.add_argument("--formats", nargs="+", default=list(CHECKED_BY), help="formats to measure (all)")
    arguments = parser.parse_args()
    formats = [name if name.startswith(".") else f".{name}" for name in arguments.formats]
    if unknown := [name for name in formats if name not in CHECKED_BY]:
        parser.error(f"--formats {', '.join(unknown)}: there is no such format; choose from {', '.join(CHECKED_BY)}")

    source = Source.read(arguments.model, hyrfpack.load_scene(arguments.data))
    degrees = sorted({0, *arguments.degrees})
    baked, seconds = time_action(lambda: bake(source.model, source.fit_cameras, degrees))
    print(f"{len(source.model):,} Gaussians, {len(source.measured_views)} views; baked in {seconds:.1f} s", end="")
    background, picture = None, None
    if source.model.config.background:
        background, seconds = time_action(lambda: make_background_splats(source.model, source.fit_cameras))
        picture = render_background_picture(source.model, cameras=source.fit_cameras)
        print(f", the background as {len(background):,} more in {seconds:.1f} s", end="")
    splats_with_background = {
        d: splats if background is None else concatenate((splats, background)) for d, splats in baked.items()
    }
    model_scores = measure_scores(source, {})["model"]
    print(f"; the model itself: {arguments.model.stat().st_size:,} bytes, {model_scores.photos:.2f} dB on photos\n")
    print(markdown_table(TABLE_COLUMNS, []))
    for name in formats:
        output_format = FORMATS.get(name.split()[0], HTML_PAGE)
        for degree in sorted({min(degree, output_format.max_degree) for degree in arguments.degrees}):
            print_row(source, name, degree, baked, splats_with_background, picture)


def print_row(
    source: Source,
    name: str,
    degree: int,
    baked: dict[int, Splats],
    splats_with_background: dict[int, Splats],
    picture: np.ndarray | None,
) -> None:
    """Encode, decode and score one file, and print its row."""
    if name == HTML_PAGE.ending:
        data, write = time_second_call(lambda: encode_baked_page(source, baked[degree], picture, "scene"))
        decoded, read = time_second_call(lambda: decode_splats_page(data, name))
    else:
        splat_format = FORMATS[name.split()[0]]
        hints = Hints(source.up, source.cameras[0][1], 3 if name.endswith("v3") else DEFAULT_SPZ_VERSION)
        data, write = time_second_call(lambda: splat_format.encode(splats_with_background[degree], hints))
        decoded, read = time_second_call(lambda: (splat_format.decode(data, name), None))
    file = measure_scores(source, {"file": decoded})["file"]
    numbers = [f"{len(data):,}", *(f"{number:.2f}" for number in (write, read, file.model, file.photos))]
    print(markdown_row([name, str(degree), *numbers, CHECKED_BY[name]]), flush=True)


def measure_scores(source: Source, contenders: dict[str, tuple[Splats, np.ndarray | None]]) -> dict[str, PsnrScores]:
    """Return the PSNR scores of splats with their backgrounds, by name."""
    return measure_psnr(source.model, contenders, source.measured_views, sphere=source.model.config.background)


def time_action(action: Callable[[], TaskResult]) -> tuple[TaskResult, float]:
    """Run an action; return its result and its duration in seconds."""
    start = time.perf_counter()
    result = action()
    return result, time.perf_counter() - start


def time_second_call(action: Callable[[], TaskResult]) -> tuple[TaskResult, float]:
    """Run an action twice, as the first call imports packages and compiles kernels; return as `time_action`."""
    action()
    return time_action(action)


if __name__ == "__main__":
    run_command(main)

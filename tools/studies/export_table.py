"""What leaving costs: bytes, time and loss of every format that a model can be exported to.

    python -m tools.studies.export_table runs/bonsai/model.hyrf data/bonsai
    python -m tools.studies.export_table runs/bonsai/model.hyrf data/bonsai --degrees 0 1 2 3 --formats ply spz

Colours are fitted at the training cameras. Every file is read back by our own reader and drawn by our own rasteriser at
the held-out views, beside the model's own pictures and the photos. The times are of packing and unpacking alone; what
baking takes stands above the table. That other programs read the same numbers is what `tests/independent` checks.
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
from hyrfpack.export.background import background_picture, background_splats
from hyrfpack.export.bake import bake
from hyrfpack.export.kinds import HTML_PAGE
from hyrfpack.export.measure import PsnrScores, measure_psnr
from hyrfpack.export.pages import encode_baked_page
from hyrfpack.export.source import Source
from hyrfpack.splats.formats.hints import Hints
from hyrfpack.splats.splats import Splats, concatenate
from hyrfpack.splats.table import FORMATS
from hyrfpack.web.html import decode_splats_page

Result = TypeVar("Result")

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
    parser.add_argument("data", type=Path, help="its photos")
    parser.add_argument("--degrees", type=int, nargs="+", default=[3], help="of the spherical harmonics")
    parser.add_argument("--formats", nargs="+", default=list(CHECKED_BY), help="which")
    arguments = parser.parse_args()
    formats = [name if name.startswith(".") else f".{name}" for name in arguments.formats]

    source = Source.read(arguments.model, hyrfpack.load_scene(arguments.data))
    degrees = sorted({0, *arguments.degrees})
    baked, seconds = timed(lambda: bake(source.model, source.fit_cameras, degrees))
    print(f"{len(source.model):,} Gaussians, {len(source.measured_views)} views; baked in {seconds:.1f} s", end="")
    behind, picture = None, None
    if source.model.config.background:
        behind, seconds = timed(lambda: background_splats(source.model, source.fit_cameras))
        picture = background_picture(source.model, cameras=source.fit_cameras)
        print(f", the background as {len(behind):,} more in {seconds:.1f} s", end="")
    whole = {d: splats if behind is None else concatenate((splats, behind)) for d, splats in baked.items()}
    own = score(source, {})["model"]
    print(f"; the model itself: {arguments.model.stat().st_size:,} bytes, {own.photos:.2f} dB on photos\n")
    print("| format | degree | bytes | write (s) | read (s) | dB, model | dB, photos | checked by |")
    print("|---|---|---|---|---|---|---|---|")
    for name in formats:
        kind = FORMATS.get(name.split()[0], HTML_PAGE)
        for degree in sorted({min(degree, kind.max_degree) for degree in arguments.degrees}):
            row(source, name, degree, baked, whole, picture)


def row(
    source: Source,
    name: str,
    degree: int,
    baked: dict[int, Splats],
    whole: dict[int, Splats],
    picture: np.ndarray | None,
) -> None:
    """Write, read, score and print one file."""
    if name == HTML_PAGE.ending:
        data, write = timed(lambda: encode_baked_page(source, baked[degree], picture, "scene"))
        back, read = timed(lambda: decode_splats_page(data, name))
    else:
        form = FORMATS[name.split()[0]]
        hints = Hints(source.up, source.cameras[0][1], 3 if name.endswith("v3") else DEFAULT_SPZ_VERSION)
        data, write = timed(lambda: form.encode(whole[degree], hints))
        back, read = timed(lambda: (form.decode(data, name), None))
    file = score(source, {"file": back})["file"]
    print(
        f"| {name} | {degree} | {len(data):,} | {write:.2f} | {read:.2f} | {file.model:.2f} | {file.photos:.2f} "
        f"| {CHECKED_BY[name]} |",
        flush=True,
    )


def score(source: Source, contenders: dict[str, tuple[Splats, np.ndarray | None]]) -> dict[str, PsnrScores]:
    """Of splats and what lies behind them, by name."""
    return measure_psnr(source.model, contenders, source.measured_views, sphere=source.model.config.background)


def timed(action: Callable[[], Result]) -> tuple[Result, float]:
    """What an action gives, and its seconds."""
    start = time.perf_counter()
    result = action()
    return result, time.perf_counter() - start


if __name__ == "__main__":
    main()

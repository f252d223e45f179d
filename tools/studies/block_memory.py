"""Measure the memory of training in blocks against the size of the scene, at blocks of the same size.

    python -m tools.scenes.write_set --out sets --scenes city --photos 240 --width 320
    python -m tools.studies.block_memory sets/city --tiles 1 4 16 --points 60000

A row of copies of a set is one large scene: each copy has --photos of its photos, and --points points, which only these
photos show. It trains for 2 steps in as many blocks as it has copies, and as one run. Each run is a child process with
a cache of photos of 32 MB. The table has the Gaussians of the largest block, and in MiB the memory of the process with
the scene loaded, its peak before blocks are merged, and its peak at the end.

The results are in docs/research/blocks.md.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import hyrfpack
from hyrfpack.blocks import run as blocks_run
from hyrfpack.cameras.placement import Placement
from hyrfpack.data import PictureCache
from hyrfpack.scene import Scene, evenly_spaced
from tools.command import positive_integer, read_child_json, run_command
from tools.scenes.layout_city import BLOCKS_PER_SIDE, PITCH_METRES
from tools.tables import markdown_row, markdown_table

TRAINING_STEPS = 2
MAX_SIDE_PIXELS = 160
CACHE_BYTES = 32 << 20
JITTER_METRES = 0.3
TILE_METRES = 1.5 * BLOCKS_PER_SIDE * PITCH_METRES
TABLE_COLUMNS = ("tiles", "blocks", "Gaussians of the largest block", "scene loaded", "peak of training", "peak of all")


def thin(scene: Scene, photos: int, points: int, rng: np.random.Generator) -> Scene:
    """Return a scene of some of the photos, without held-out ones, with `points` points near those of the scene."""
    views = evenly_spaced(scene.train, photos)
    source = np.sort(rng.integers(len(scene.points), size=points))
    tracks = {view.name: np.flatnonzero(np.isin(source, scene.tracks[view.name])) for view in views}
    positions = scene.points[source] + rng.normal(0, JITTER_METRES, (points, 3))
    colors = scene.point_colors[source]
    return replace(scene, train=views, test=[], points=positions, point_colors=colors, tracks=tracks, reading={})


def tile(scene: Scene, tiles: int) -> Scene:
    """Return a row of copies of a scene."""
    placements = [Placement.translation((TILE_METRES * number, 0.0, 0.0)) for number in range(tiles)]
    views = [
        replace(placement.move_view(view), name=f"{number:02d}/{view.name}")
        for number, placement in enumerate(placements)
        for view in scene.train
    ]
    tracks = {
        f"{number:02d}/{name}": rows + number * len(scene.points)
        for number in range(tiles)
        for name, rows in scene.tracks.items()
    }
    points = np.concatenate([scene.points + placement.offset for placement in placements])
    colors = np.tile(scene.point_colors, (tiles, 1))
    return replace(scene, train=views, points=points, point_colors=colors, tracks=tracks)


def read_memory(key: str) -> float:
    """Return a row of the memory of this process in MiB: "VmRSS" at present, "VmHWM" for the peak."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith(f"{key}:"))


def measure(folder: Path, tiles: int, blocks: int, photos: int, points: int) -> dict[str, Any]:
    """Train once in this process; return the cells of a row."""
    scene = hyrfpack.load_scene(folder, max_size=MAX_SIDE_PIXELS)
    scene = tile(thin(scene, photos, points, np.random.default_rng(0)), tiles)
    row: dict[str, Any] = {"loaded": read_memory("VmRSS")}
    merge_blocks = blocks_run.merge_blocks

    def merge(*arguments: Any, **more: Any) -> Any:
        row["trained"] = read_memory("VmHWM")
        return merge_blocks(*arguments, **more)

    blocks_run.merge_blocks = merge
    config = hyrfpack.TrainConfig(steps=TRAINING_STEPS, max_gaussians=len(scene.points), exposure=False)
    context = hyrfpack.RunContext(progress=None, cache=PictureCache(CACHE_BYTES))
    with tempfile.TemporaryDirectory() as out:
        hyrfpack.train_blocks(scene, out, config, f"{blocks}x1", context=context)
    peak = read_memory("VmHWM")
    largest = len(scene.points)
    if blocks > 1:
        largest = max(block.point_count for block in blocks_run.plan_blocks(scene, blocks, 1).blocks)
    return {"largest": largest, "trained": peak, **row, "peak": peak}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="the set `city`")
    parser.add_argument(
        "--tiles", type=positive_integer, nargs="+", default=[1, 4, 16], help="copies of the set (1 4 16)"
    )
    parser.add_argument("--photos", type=positive_integer, default=24, help="photos of each copy (24)")
    parser.add_argument("--points", type=positive_integer, default=60_000, help="points of each copy (60,000)")
    parser.add_argument("--child", type=int, help=argparse.SUPPRESS)  # the blocks of one run
    arguments = parser.parse_args()
    if arguments.child:
        row = measure(arguments.folder, arguments.tiles[0], arguments.child, arguments.photos, arguments.points)
        print(json.dumps(row))
        return
    rows = []
    for tiles in arguments.tiles:
        for blocks in sorted({tiles, 1}):
            options = ["--tiles", tiles, "--child", blocks, "--photos", arguments.photos, "--points", arguments.points]
            row = read_child_json("tools.studies.block_memory", [arguments.folder, *options])
            memory = [f"{row[name]:,.0f}" for name in ("loaded", "trained", "peak")]
            rows.append([str(tiles), str(blocks), f"{row['largest']:,}", *memory])
            print(markdown_row(rows[-1]), flush=True)
    print(markdown_table(TABLE_COLUMNS, rows))


if __name__ == "__main__":
    run_command(main)

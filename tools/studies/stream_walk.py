"""Walk through scene folders in the web player: times, bytes, Gaussians in memory against the budget, and memory.

    python -m tools.studies.tile_scene runs/million-scene --copies 5 --out runs/5m-scene
    python -m tools.studies.stream_walk runs/million-scene runs/5m-scene --budget 250000 --unsplit runs/million.hyrf

The camera glides between --stops cameras of the capture, in turn in each part of the scene, and rests --rest seconds at
each. The resolution and the budget are not reduced on slow devices. Of each folder, and of the page of each file after
--unsplit, the table has:

- seconds to the first picture, and bytes received by then
- bytes received at the end of the walk
- the most Gaussians drawn, and the most in memory, at any time of the walk
- mean predicted PSNR in dB at the end of the rests, against the finest levels
- median ms of the frames of a glide
- megabytes of textures at the end, and the most memory of all processes of the browser (PSS); where it draws in
  software, these hold the textures, too

The results are in docs/research/levels.md.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import hyrfpack
from hyrfpack.cameras.files import camera_from_numbers, camera_to_json
from hyrfpack.scene import Camera, evenly_spaced
from tools.browser.chromium import Chromium
from tools.command import positive_integer, run_command
from tools.studies.large_model import COUNT_TEXTURES_SCRIPT
from tools.studies.scene_page import serve_scene
from tools.studies.web_player import PAGE_TIMEOUT_SECONDS, read_stored_cameras
from tools.tables import markdown_row, markdown_table

WINDOW_SIZE = (640, 400)
POLL_SECONDS = 0.5
RECORD_SCRIPT = """(() => {
  const { player } = hyrfpack, record = { firstBytes: null, drawn: 0, resident: 0, frames: [] };
  window.walkRecord = record;
  player.automatic = false;
  player.addEventListener("streamed", ({ detail }) => {
    record.drawn = Math.max(record.drawn, detail.gaussians);
    record.resident = Math.max(record.resident, detail.resident);
  });
  player.addEventListener("frame", ({ detail }) => record.frames.push(detail));
  const look = () => {
    // The state of a stream may come after its first picture; the page of a file has none.
    if (player.times.first === null || player.loader.state === null) requestAnimationFrame(look);
    else record.firstBytes = player.loader.state?.bytes ?? null;
  };
  look();
})()"""
TABLE_COLUMNS = (
    *("scene", "Gaussians", "first s", "first bytes", "bytes after the walk", "most drawn", "most in memory"),
    *("PSNR", "frame ms", "textures MB", "browser MB"),
)


@dataclass
class Walk:
    """What a walk through one scene has measured; memory in bytes."""

    seconds: float
    record: dict[str, Any]
    state: dict[str, Any] | None
    rest_psnrs: list[float]
    texture_bytes: int
    browser_bytes: int


def list_stops(folder: Path, count: int) -> list[Camera]:
    """Return the cameras at which a walk stops, in turn in each part of the scene."""
    scene = hyrfpack.SceneFolder(folder)
    cameras = evenly_spaced([camera_from_numbers(numbers) for numbers in scene.manifest.cameras], count)
    centers = [np.array(fields.config.frame.center) for fields in scene.fields]
    stops = []
    for number, camera in enumerate(cameras):
        offset = centers[number * len(centers) // len(cameras)] - centers[0]
        pose = camera.camera_from_world.copy()
        pose[:3, 3] -= pose[:3, :3] @ offset
        stops.append(replace(camera, camera_from_world=pose))
    return stops


def walk(address: str, stops: Sequence[Camera], rest_seconds: float) -> Walk:
    """Open a page and walk through its scene."""
    browser = Chromium(timeout_seconds=PAGE_TIMEOUT_SECONDS)
    with browser:
        browser.resize(*WINDOW_SIZE)
        with browser.before_every_page(COUNT_TEXTURES_SCRIPT):
            browser.open(address)
        browser.evaluate(RECORD_SCRIPT)
        browser.evaluate("hyrfpack.ready")
        browser_bytes, rest_psnrs = 0, []
        for stop in stops:
            browser.evaluate(f"void (location.hash = 'camera=' + JSON.stringify({json.dumps(camera_to_json(stop))}))")
            rested_at = None
            while rested_at is None or time.perf_counter() < rested_at + rest_seconds:
                time.sleep(POLL_SECONDS)
                browser_bytes = max(browser_bytes, browser.measure_memory())
                if rested_at is None and not browser.evaluate("hyrfpack.player.moving"):
                    rested_at = time.perf_counter()
            rest_psnrs.append(browser.evaluate("hyrfpack.player.loader.state?.psnr ?? NaN"))
        record, state = browser.evaluate("walkRecord"), browser.evaluate("hyrfpack.player.loader.state ?? null")
        seconds = browser.evaluate("hyrfpack.player.times.first") / 1000
        if errors := browser.list_errors():
            print(errors, flush=True)
        return Walk(seconds, record, state, rest_psnrs, browser.evaluate("countTextureBytes()"), browser_bytes)


def make_row(name: str, gaussians: int, file_bytes: int | None, result: Walk) -> list[str]:
    """Return the row of the table of a walk; `file_bytes` are those of a page that is not streamed."""
    if result.state is None:
        cells = [f"{file_bytes:,}", f"{file_bytes:,}", f"{gaussians:,}", f"{gaussians:,}", ""]
    else:
        counts = (result.record["firstBytes"], result.state["bytes"], result.record["drawn"], result.record["resident"])
        cells = [*(f"{count:,}" for count in counts), f"{np.mean(result.rest_psnrs):.1f}"]
    memory = (result.texture_bytes, result.browser_bytes)
    frame_ms = np.median(result.record["frames"])
    megabytes = [f"{size / 1e6:.0f}" for size in memory]
    return [name, f"{gaussians:,}", f"{result.seconds:.1f}", *cells, f"{frame_ms:.0f}", *megabytes]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+", help="scene folders")
    parser.add_argument("--unsplit", type=Path, nargs="*", default=[], help=".hyrf files, drawn by a page as they are")
    parser.add_argument("--budget", type=int, default=250_000, help="the most Gaussians to draw (250,000)")
    parser.add_argument("--stops", type=positive_integer, default=8, help="cameras at which the walk rests (8)")
    parser.add_argument("--rest", type=float, default=10.0, help="seconds at each stop (10)")
    arguments = parser.parse_args()
    rows = []
    for folder in arguments.folders:
        stops, count = list_stops(folder, arguments.stops), hyrfpack.SceneFolder(folder).manifest.gaussians
        with serve_scene(folder, arguments.budget) as address:
            result = walk(address, stops, arguments.rest)
        rows.append(make_row(folder.name, count, None, result))
        print(markdown_row(rows[-1]), flush=True)
    for file in arguments.unsplit:
        with tempfile.TemporaryDirectory() as temporary:
            page = Path(temporary, "page.html")
            hyrfpack.export_model(file, page)
            result = walk(page.as_uri(), read_stored_cameras(file, arguments.stops), arguments.rest)
            rows.append(make_row(file.name, len(hyrfpack.load_merged_model(file)), page.stat().st_size, result))
        print(markdown_row(rows[-1]), flush=True)
    print(markdown_table(TABLE_COLUMNS, rows))


if __name__ == "__main__":
    run_command(main)

"""Measure the web player in a real browser: its pictures, its bytes and its times, for native and baked pages.

    python -m tools.studies.web_player --runs runs/sets/1000 --data ../shared/data
    python -m tools.studies.web_player --large runs/100k/compact.hyrf runs/1m/compact.hyrf

With --runs it draws eight held-out views of each data set's `compact.hyrf` with the native and the baked page in
headless Chromium. The table has bytes, PSNR in dB against the pictures of `render_view` (mean and worst), and the
difference of PSNR against the photos. With --large it measures the seconds from opening a page to the first and to the
complete picture. It also measures the ms per frame while a mouse orbits at full resolution. These are medians over
--repeats, where native and baked pages alternate, each in a new browser. Without a GPU the browser renders in software.

The results are in docs/research/browser.md.
"""

from __future__ import annotations

import argparse
import base64
import json
import statistics
import tempfile
import time
from pathlib import Path

import numpy as np

import hyrfpack
from hyrfpack.cameras.capture import Capture
from hyrfpack.cameras.files import camera_to_json
from hyrfpack.measure.psnr import psnr_from_mse
from hyrfpack.scene import Camera, Scene, evenly_spaced
from tools.browser.browser import Browser
from tools.browser.chromium import Chromium
from tools.command import positive_integer, run_command
from tools.studies.train_sets import DATA_FOLDER
from tools.tables import print_measured_table

COMPARED_VIEWS = 8
WINDOW_SIZE = (1280, 800)
ORBIT_SECONDS = 6.0  # frames are counted for this long
PAGE_TIMEOUT_SECONDS = 900.0
# Settings without any approximation.
EXACT_SETTINGS = hyrfpack.RenderSettings(background_threshold=0, transmittance_min=0)
READ_PIXELS_SCRIPT = "btoa(Array.from(hyrfpack.pixels(), (byte) => String.fromCharCode(byte)).join(''))"


def psnr(first: np.ndarray, second: np.ndarray) -> float:
    """Return the PSNR in dB of two pictures in [0, 1]."""
    return psnr_from_mse(float(np.mean((first - second) ** 2)))


def read_stored_cameras(model: Path, count: int) -> list[Camera]:
    """Return at most `count` evenly spaced cameras of those that a model stores."""
    return evenly_spaced(Capture(hyrfpack.describe_file(model)).cameras, count)


def read_from_page(browser: Browser, camera: Camera) -> np.ndarray:
    """Draw the view of a camera in the page; return the values in [0, 1] of its picture, row by row."""
    browser.evaluate(f"hyrfpack.show({json.dumps(camera_to_json(camera))})")
    return np.frombuffer(base64.b64decode(browser.evaluate(READ_PIXELS_SCRIPT)), np.uint8) / 255


def draw_in_page(browser: Browser, camera: Camera) -> np.ndarray:
    """Draw the view of a camera in the page; return (H, W, 3) in [0, 1]."""
    return read_from_page(browser, camera).reshape(camera.height, camera.width, 3)


def write_pages(model: Path, folder: Path, data: Scene | None = None) -> dict[str, Path]:
    """Write the native and the baked page of a model; baked colours are fitted at the cameras of `data`, if given."""
    paths = {"native": folder / f"{model.parent.name}.html", "baked": folder / f"{model.parent.name}.baked.html"}
    for name, path in paths.items():
        hyrfpack.export_model(model, path, hyrfpack.ExportConfig(baked=name == "baked"), data=data)
    return paths


def open_page(browser: Browser, page: Path) -> None:
    """Open a page and wait until it is ready."""
    browser.open(page.as_uri())
    browser.evaluate("hyrfpack.ready")


def measure_pictures(run: Path, data: Path, folder: Path) -> list[str]:
    """Return the row of one data set in the table of pictures."""
    model = run / "compact.hyrf"
    scene = hyrfpack.load_scene(data)
    views = evenly_spaced(scene.test, COMPARED_VIEWS)
    loaded = hyrfpack.load_model(model)
    model_pictures = [hyrfpack.render_view(loaded, view.camera).rgb.clamp(0, 1).numpy() for view in views]
    solid = np.array(loaded.config.solid, np.float32)
    photos = [view.load().composite(solid) for view in views]
    scores: dict[str, list[float]] = {}
    cells = [run.name, f"{model.stat().st_size:,}"]
    pictures_by_source = {"hyrfpack": model_pictures}
    page_paths = write_pages(model, folder, scene)
    with Chromium(timeout_seconds=PAGE_TIMEOUT_SECONDS) as browser:
        for name, page in page_paths.items():
            open_page(browser, page)
            pictures_by_source[name] = [draw_in_page(browser, view.camera) for view in views]
    for name, pictures in pictures_by_source.items():
        scores[name] = [
            psnr(picture, model_picture) for picture, model_picture in zip(pictures, model_pictures, strict=True)
        ]
        scores[f"{name} photos"] = [psnr(picture, photo) for picture, photo in zip(pictures, photos, strict=True)]
    for name, page in page_paths.items():
        psnr_to_model = scores[name]
        photo = statistics.mean(scores[f"{name} photos"]) - statistics.mean(scores["hyrfpack photos"])
        cells += [
            f"{page.stat().st_size:,}",
            f"{statistics.mean(psnr_to_model):.1f}",
            f"{min(psnr_to_model):.1f}",
            f"{photo:+.3f}",
        ]
    return cells


def orbit_with_mouse(browser: Browser, x: float, y: float) -> None:
    """Move the mouse for ORBIT_SECONDS from a point in pixels, at which its button is down."""
    started, step = time.perf_counter(), 0
    while time.perf_counter() < started + ORBIT_SECONDS:
        step += 1
        browser.move(x + 3 * (step % 60), y)
        time.sleep(0.02)


def measure_frame_ms(browser: Browser) -> float:
    """Return the milliseconds per frame at full resolution while a mouse orbits."""
    browser.evaluate("document.getElementById('automatic').checked && document.getElementById('automatic').click()")
    x, y = WINDOW_SIZE[0] / 2, WINDOW_SIZE[1] / 2
    browser.button_down(x, y)
    first_frame, started = browser.evaluate("hyrfpack.frames()"), time.perf_counter()
    orbit_with_mouse(browser, x, y)
    frames, seconds = browser.evaluate("hyrfpack.frames()") - first_frame, time.perf_counter() - started
    browser.button_up(x, y)
    return 1000 * seconds / max(1, frames)


def measure_times(model: Path, folder: Path, repeats: int) -> list[list[str]]:
    """Return the two rows of one model in the table of times, native and baked."""
    page_paths = write_pages(model, folder)
    samples: dict[str, list[tuple[float, float, float]]] = {name: [] for name in page_paths}
    for _ in range(repeats):
        for name, page in page_paths.items():
            with Chromium(timeout_seconds=PAGE_TIMEOUT_SECONDS) as browser:
                browser.resize(*WINDOW_SIZE)
                open_page(browser, page)
                browser.evaluate("hyrfpack.player.settled")
                first, complete = (
                    browser.evaluate(f"hyrfpack.player.times.{column}") / 1000 for column in ("first", "complete")
                )
                samples[name].append((first, complete, measure_frame_ms(browser)))
    count = len(hyrfpack.load_model(model))
    return [
        [f"{count:,}", name, f"{page.stat().st_size:,}"]
        + [f"{statistics.median(column):.2f}" for column in zip(*samples[name], strict=True)]
        for name, page in page_paths.items()
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=Path, help="folder of runs, written by tools.studies.train_sets")
    parser.add_argument("--sets", nargs="*", help="data sets to compare (all)")
    parser.add_argument("--data", type=Path, default=DATA_FOLDER, help="folder of the data sets")
    parser.add_argument("--large", type=Path, nargs="*", default=[], help="models to time")
    parser.add_argument("--repeats", type=positive_integer, default=3, help="number of repeats of each time (3)")
    arguments = parser.parse_args()
    if not arguments.runs and not arguments.large:
        parser.error("nothing to measure; name --runs, --large or both")
    with tempfile.TemporaryDirectory() as folder:
        if arguments.runs:
            runs = [arguments.runs / name for name in arguments.sets or []] or sorted(
                path.parent for path in arguments.runs.glob("*/compact.hyrf")
            )
            columns = [
                f"{name} {column}" for name in ("native", "baked") for column in ("bytes", "dB", "worst", "photos dB")
            ]
            print_measured_table(
                ["set", ".hyrf bytes", *columns],
                runs,
                lambda run: [measure_pictures(run, arguments.data / run.name, Path(folder))],
            )
        if arguments.large:
            print_measured_table(
                ["Gaussians", "page", "bytes", "first s", "complete s", "frame ms"],
                arguments.large,
                lambda model: measure_times(model, Path(folder), arguments.repeats),
            )


if __name__ == "__main__":
    run_command(main)

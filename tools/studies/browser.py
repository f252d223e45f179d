"""The page in a real browser: how like hyrfpack's own pictures it draws, its bytes, and its times, native beside baked.

    python -m tools.studies.browser --runs runs/sets/1000 --data ../shared/data
    python -m tools.studies.browser --large runs/100k/compact.hyrf runs/1m/compact.hyrf

With --runs: for each set's `compact.hyrf`, eight held-out views each drawn by the native and by the baked page in
headless Chromium, against `render_view` and against the photos. With --large: the time from opening a page to the
first picture and to the complete one, and that of a frame while a mouse orbits at full resolution; medians over
--repeats, native and baked in turn, each in a browser of its own. Without a GPU the browser draws in software.
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
from hyrfpack.cameras.files import camera_to_json
from hyrfpack.scene import Camera, Scene, evenly_spaced
from tools.browser import chromium
from tools.browser.chromium import Chromium
from tools.tables import markdown_table

VIEWS = 8
WINDOW = (1280, 800)
ORBIT = 6.0  # s of frames that are counted
PATIENCE = 900.0  # s that a page may take
BYTES = "btoa(Array.from(hyrfpack.pixels(), (byte) => String.fromCharCode(byte)).join(''))"


def psnr(first: np.ndarray, second: np.ndarray) -> float:
    """dB, of pictures in [0, 1]."""
    return float(-10 * np.log10(max(np.mean((first - second) ** 2), 1e-12)))


def shown(browser: Chromium, camera: Camera) -> np.ndarray:
    """(H, W, 3) in [0, 1]: what the page draws for a camera."""
    browser.evaluate(f"hyrfpack.show({json.dumps(camera_to_json(camera))})")
    data = base64.b64decode(browser.evaluate(BYTES))
    return np.frombuffer(data, np.uint8).reshape(camera.height, camera.width, 3) / 255


def pages(model: Path, folder: Path, data: Scene | None = None) -> dict[str, Path]:
    """The native and the baked page of a model; colours are fitted where photos were taken from, if they are given."""
    found = {"native": folder / f"{model.parent.name}.html", "baked": folder / f"{model.parent.name}.baked.html"}
    for name, path in found.items():
        hyrfpack.export_model(model, path, data=data, baked=name == "baked")
    return found


def opened(browser: Chromium, page: Path) -> None:
    browser.open(page.as_uri())
    browser.evaluate("hyrfpack.ready")


def likeness(run: Path, data: Path, folder: Path) -> list[str]:
    """A row of the table of pictures: one set."""
    model = run / "compact.hyrf"
    scene = hyrfpack.load_scene(data)
    views = evenly_spaced(scene.test, VIEWS)
    field = hyrfpack.load_model(model)
    ours = [hyrfpack.render_view(field, view.camera).rgb.clamp(0, 1).numpy() for view in views]
    solid = np.array(field.config.solid, np.float32)
    photos = [view.load().composite(solid) for view in views]
    scores: dict[str, list[float]] = {}
    cells = [run.name, f"{model.stat().st_size:,}"]
    against = {"hyrfpack": ours}
    made = pages(model, folder, scene)
    with Chromium(Path(tempfile.mkdtemp(dir=folder))) as browser:
        for name, page in made.items():
            opened(browser, page)
            against[name] = [shown(browser, view.camera) for view in views]
    for name, pictures in against.items():
        scores[name] = [psnr(picture, own) for picture, own in zip(pictures, ours, strict=True)]
        scores[f"{name} photos"] = [psnr(picture, photo) for picture, photo in zip(pictures, photos, strict=True)]
    for name, page in made.items():
        like = scores[name]
        photo = statistics.mean(scores[f"{name} photos"]) - statistics.mean(scores["hyrfpack photos"])
        cells += [f"{page.stat().st_size:,}", f"{statistics.mean(like):.1f}", f"{min(like):.1f}", f"{photo:+.3f}"]
    return cells


def frame_ms(browser: Chromium) -> float:
    """Milliseconds of a frame at full resolution while a mouse orbits."""
    browser.evaluate("document.getElementById('automatic').checked && document.getElementById('automatic').click()")
    x, y = WINDOW[0] / 2, WINDOW[1] / 2
    browser.mouse("mousePressed", x, y, button="left", buttons=1, clickCount=1)
    drawn, began, step = browser.evaluate("hyrfpack.frames()"), time.perf_counter(), 0
    while time.perf_counter() < began + ORBIT:
        step += 1
        browser.mouse("mouseMoved", x + 3 * (step % 60), y, button="left", buttons=1)
        time.sleep(0.02)
    frames, seconds = browser.evaluate("hyrfpack.frames()") - drawn, time.perf_counter() - began
    browser.mouse("mouseReleased", x, y, button="left", clickCount=1)
    return 1000 * seconds / max(1, frames)


def times(model: Path, folder: Path, repeats: int) -> list[list[str]]:
    """Rows of the table of times: one model, native and baked."""
    made = pages(model, folder)
    taken: dict[str, list[tuple[float, float, float]]] = {name: [] for name in made}
    for _ in range(repeats):
        for name, page in made.items():
            with Chromium(Path(tempfile.mkdtemp(dir=folder))) as browser:
                browser.resize(*WINDOW)
                opened(browser, page)
                browser.evaluate("hyrfpack.player.settled")
                first, complete = (
                    browser.evaluate(f"hyrfpack.player.times.{what}") / 1000 for what in ("first", "complete")
                )
                taken[name].append((first, complete, frame_ms(browser)))
    count = len(hyrfpack.load_model(model))
    return [
        [f"{count:,}", name, f"{page.stat().st_size:,}"]
        + [f"{statistics.median(column):.2f}" for column in zip(*taken[name], strict=True)]
        for name, page in made.items()
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=Path, help="folder of sets, as tools.studies.train_sets leaves it")
    parser.add_argument("--sets", nargs="*", help="which of them; default all")
    parser.add_argument("--data", type=Path, help="folder of the sets' photos")
    parser.add_argument("--large", type=Path, nargs="*", default=[], help="models to time")
    parser.add_argument("--repeats", type=int, default=3, help="of each time (3)")
    arguments = parser.parse_args()
    chromium.TIMEOUT_SECONDS = PATIENCE
    with tempfile.TemporaryDirectory() as folder:
        if arguments.runs:
            runs = [arguments.runs / name for name in arguments.sets or []] or sorted(
                path.parent for path in arguments.runs.glob("*/compact.hyrf")
            )
            rows = [likeness(run, arguments.data / run.name, Path(folder)) for run in runs]
            columns = [
                f"{name} {what}" for name in ("native", "baked") for what in ("bytes", "dB", "worst", "photos dB")
            ]
            print(markdown_table(["set", ".hyrf bytes", *columns], rows))
        rows = [row for model in arguments.large for row in times(model, Path(folder), arguments.repeats)]
        if rows:
            print(markdown_table(["Gaussians", "page", "bytes", "first s", "complete s", "frame ms"], rows))


if __name__ == "__main__":
    main()

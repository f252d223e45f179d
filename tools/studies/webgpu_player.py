"""Compare the player's renderers, WebGL 2 and WebGPU, on the same models.

    python -m tools.studies.webgpu_player MODEL.hyrf --repeats 5

It opens each model in a viewer of the npm package, in headless Chromium with software for both (SwiftShader through
Vulkan), in a window of 1280 x 800. When the picture is complete, it measures:

- complete: seconds and CPU seconds of all processes of the browser until the picture is complete
- colours: microseconds a Gaussian for the decoder, with kept hash features
- frame: ms of a frame at full resolution, from the call to the end of the device's work; that of WebGPU has a sort
- sort: ms until an order for a view is there: in the worker and back, or on the device
- PSNR: of both renderers' pictures of the window, in dB

Times of colours, frames and sorts are medians over --repeats; those until the picture is complete come from one visit.
They need an otherwise idle machine.

The results are in docs/research/browser.md.
"""

from __future__ import annotations

import argparse
import shutil
import statistics
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

import hyrfpack
from tools.browser.build_package import build_package
from tools.browser.chromium import WEBGPU_FLAGS, Chromium
from tools.command import positive_integer, run_command
from tools.studies.viewer_comparison import WINDOW_SIZE, Site
from tools.studies.web_player import psnr
from tools.tables import print_measured_table

TIMEOUT_SECONDS = 900
PAGE = """<!DOCTYPE html><link rel="icon" href="data:,"><style>html, body, div { height: 100%; margin: 0; }</style>
<div id="scene"></div>
<script type="module">
import { createViewer } from "./hyrf-viewer/index.js";
import { webgpu } from "./hyrf-viewer/webgpu.js";
const renderer = location.hash === "#webgpu" ? { renderer: webgpu } : {};
window.viewer = createViewer({ container: "#scene", src: "scene.hyrf", interaction: "none", ...renderer });
</script>
"""
COMPLETE_PICTURE_SCRIPT = """(async () => {
  while (!window.viewer?.isReady) await new Promise((resolve) => setTimeout(resolve, 20));
  await viewer.player.settled;
  return Boolean(viewer.player.renderer.isOnDevice);
})()"""
# Returns the times in ms of each repetition: of all colours, of a frame, and of a sort.
TIMING_SCRIPT = """(async () => {
  await new Promise((resolve) => setTimeout(resolve, 3000)); // work that is done ahead ends meanwhile
  const { player } = viewer, { renderer, loader, scene } = player, { content } = renderer, view = player.view();
  player.pause();
  const { graphics } = renderer.painter ?? renderer, rows = Array.from({ length: content.height }, (_, row) => row);
  const sortOnDevice = () => {
    const encoder = graphics.device.createCommandEncoder(), pass = encoder.beginComputePass();
    content.sort.encode(pass);
    pass.end();
    graphics.device.queue.submit([encoder.finish()]);
  };
  const kinds = {
    colors: () => content.color(rows, view.eye),
    frame: () => renderer.draw(view, 1, player.exposureOf(view)),
    sort: () => (content.sortsItself ? sortOnDevice() : loader.sort(view, scene)),
  };
  const times = { colors: [], frame: [], sort: [] };
  for (let k = 0; k <= %d; k++) {
    for (const [name, work] of Object.entries(kinds)) {
      await graphics.whenDone();
      const began = performance.now();
      await work();
      await graphics.whenDone();
      if (k) times[name].push(performance.now() - began);
    }
  }
  return times;
})()"""
PIXELS_SCRIPT = """(() => {
  const { player } = viewer, { renderer, canvas } = player, view = player.view();
  const flat = new OffscreenCanvas(canvas.width, canvas.height).getContext("2d");
  renderer.draw(view, 1, player.exposureOf(view));
  renderer.present();
  flat.drawImage(canvas, 0, 0);
  const { data } = flat.getImageData(0, 0, canvas.width, canvas.height);
  return Array.from(data, (value) => String.fromCharCode(value)).join("");
})()"""


def measure(address: str, kind: str, repeats: int, count: int) -> tuple[list[str], np.ndarray]:
    """Return the row of a renderer without its name, and the colours (N, 3) in [0, 1] of its picture."""
    with Chromium(*WEBGPU_FLAGS, timeout_seconds=TIMEOUT_SECONDS) as browser:
        browser.resize(*WINDOW_SIZE)
        cpu, began = browser.cpu_seconds(), time.monotonic()
        browser.open(f"{address}/index.html#{kind}")
        if browser.evaluate(COMPLETE_PICTURE_SCRIPT) != (kind == "webgpu"):
            raise SystemExit("this Chromium does not draw with WebGPU")
        complete = [time.monotonic() - began, browser.cpu_seconds() - cpu]
        times = browser.evaluate(TIMING_SCRIPT % repeats)
        pixels = np.frombuffer(browser.evaluate(PIXELS_SCRIPT).encode("latin-1"), np.uint8).reshape(-1, 4)
    colors, frame, sort = (statistics.median(times[name]) for name in ("colors", "frame", "sort"))
    waits = [f"{value:.1f}" for value in complete]
    return [*waits, f"{1000 * colors / count:.1f}", f"{frame:,.0f}", f"{sort:,.1f}"], pixels[:, :3] / 255


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", type=Path, nargs="+", help=".hyrf files")
    parser.add_argument("--repeats", type=positive_integer, default=5, help="repetitions of each work (5)")
    arguments = parser.parse_args()
    columns = ["complete, s", "CPU, s", "colours, us", "frame, ms", "sort, ms", "PSNR, dB"]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        build_package(folder / "hyrf-viewer")
        (folder / "index.html").write_text(PAGE)

        def measure_model(model: Path) -> Iterator[list[str]]:
            shutil.copy(model, folder / "scene.hyrf")
            count, pictures = len(hyrfpack.load_model(model)), []
            site = Site(folder)
            with site.run():
                for kind in ("webgl", "webgpu"):
                    row, picture = measure(site.address, kind, arguments.repeats, count)
                    pictures.append(picture)
                    yield [f"{count:,}", kind, *row, f"{psnr(*pictures):.1f}" if len(pictures) == 2 else ""]

        print_measured_table(["Gaussians", "renderer", *columns], arguments.models, measure_model)


if __name__ == "__main__":
    run_command(main)

"""Measure how closely the web player's pictures match exact renders, at rest and while the view moves.

    python -m tools.studies.player_psnr runs/street/compact.hyrf runs/bonsai/compact.hyrf --views 8 --enlarge 1 3

For cameras that each model stores, in pictures as large as the photos or --enlarge times as large, the table has the
mean and the worst PSNR in dB of the page of `hyrfpack export` against `render_view` without any approximation: at rest,
and as frames are drawn at a part of the resolution while the view moves, against the mean over blocks of the exact
render. Moving frames have the panorama behind them, or the background of the view, which devices that evaluate it
quickly enough take. The browser is headless Chromium.

The results are in docs/research/browser.md.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

import hyrfpack
from hyrfpack.scene import Camera
from tools.browser.browser import Browser
from tools.browser.chromium import Chromium
from tools.command import positive_integer, run_command
from tools.studies.web_player import (
    EXACT_SETTINGS,
    PAGE_TIMEOUT_SECONDS,
    draw_in_page,
    open_page,
    psnr,
    read_from_page,
    read_stored_cameras,
)
from tools.tables import print_measured_table

# From here on, pictures are those of frames at a part of the resolution, before they are enlarged, without what is
# added at rest. The panorama has its final tiles in view, as after a rest at a view near this one. With
# `hyrfpack.follows`, the background is evaluated for the view instead, as where the device is quick enough.
MOVING_SCRIPT = """(() => {
  const { renderer } = hyrfpack.player, { content, gl } = renderer, { complete } = content;
  content.complete = async function (view, ...rest) {
    await this.panorama?.complete(view, () => true);
    const isComplete = await complete.call(this, view, ...rest);
    if (this.sky) this.sky.key = null;
    if (hyrfpack.follows) this.sky?.follow(view, 0, 0);
    return isComplete;
  };
  renderer.read = function (view, gains) {
    this.draw(view, 1 / %d, gains);
    const { target, size: [width, height] } = this.frame, rgba = new Uint8Array(4 * width * height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, rgba);
    return rgba.filter((_, place) => (place & 3) !== 3);
  };
})()"""


def enlarge_camera(camera: Camera, enlarge: int) -> Camera:
    """Return the camera with a picture that is `enlarge` times as large."""
    fx, fy, cx, cy = (enlarge * value for value in camera.intrinsics)
    return Camera(enlarge * camera.width, enlarge * camera.height, fx, fy, cx, cy, camera.camera_from_world)


def cut_camera(camera: Camera, factor: int) -> Camera:
    """Return the camera with its picture cut to a multiple of `factor` pixels."""
    return replace(camera, width=camera.width // factor * factor, height=camera.height // factor * factor)


def reduce_picture(picture: np.ndarray, factor: int) -> np.ndarray:
    """Return the mean over blocks of `factor` x `factor` pixels of a picture (H, W, 3)."""
    height, width, channels = picture.shape
    return picture.reshape(height // factor, factor, width // factor, factor, channels).mean((1, 3))


@torch.no_grad()
def render_exact(model: hyrfpack.MergedModel, cameras: Sequence[Camera]) -> list[np.ndarray]:
    """Return exact renders (H, W, 3) in [0, 1]."""
    return [hyrfpack.render_view(model, camera, EXACT_SETTINGS).rgb.clamp(0, 1).numpy() for camera in cameras]


def draw_moving(browser: Browser, camera: Camera, factor: int) -> np.ndarray:
    """Return the picture of a moving frame at 1 / factor of the resolution, (H / factor, W / factor, 3) in [0, 1].

    The page draws more rows than that. The result has means of them.
    """
    width, height = camera.width // factor, camera.height // factor
    return read_from_page(browser, camera).reshape(height, -1, width, 3).mean(1)


def measure_page(browser: Browser, model: Path, views: int, factor: int, enlarge: int) -> list[str]:
    """Return the row of a model whose page is open."""
    cameras = [cut_camera(enlarge_camera(camera, enlarge), factor) for camera in read_stored_cameras(model, views)]
    loaded = hyrfpack.load_merged_model(model)
    exact = render_exact(loaded, cameras)
    still = [psnr(draw_in_page(browser, camera), picture) for camera, picture in zip(cameras, exact, strict=True)]
    browser.evaluate(MOVING_SCRIPT % factor)
    table = [still]
    for follows in ("false", "true"):
        browser.evaluate(f"hyrfpack.follows = {follows}")
        pictures = [draw_moving(browser, camera, factor) for camera in cameras]
        table.append([psnr(*pair) for pair in zip(pictures, (reduce_picture(p, factor) for p in exact), strict=True)])
    cells = [f"{statistic(scores):.1f}" for scores in table for statistic in (statistics.mean, min)]
    return [f"{model.parent.name}/{model.name}", f"{len(loaded):,}", str(enlarge), *cells]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", type=Path, nargs="+", help=".hyrf files")
    parser.add_argument("--views", type=positive_integer, default=8, help="number of views of each model (8)")
    parser.add_argument(
        "--factor", type=positive_integer, default=2, help="moving frames have 1/N of the resolution (2)"
    )
    parser.add_argument(
        "--enlarge", type=positive_integer, nargs="+", default=[1], help="sizes of pictures in sizes of photos (1)"
    )
    arguments = parser.parse_args()
    kinds = ("still", "moving", "moving, view's background")
    columns = [f"{kind}, {statistic} dB" for kind in kinds for statistic in ("mean", "worst")]
    with tempfile.TemporaryDirectory() as folder, Chromium(timeout_seconds=PAGE_TIMEOUT_SECONDS) as browser:
        browser.resize(320, 200)  # pictures of cameras do not depend on the window

        def measure_model(model: Path) -> Iterator[list[str]]:
            page = Path(folder) / "page.html"
            hyrfpack.export_model(model, page, overwrite=True)
            for enlarge in arguments.enlarge:
                open_page(browser, page)
                yield measure_page(browser, model, arguments.views, arguments.factor, enlarge)

        print_measured_table(["model", "Gaussians", "size", *columns], arguments.models, measure_model)


if __name__ == "__main__":
    run_command(main)

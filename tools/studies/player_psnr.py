"""Measure how closely the web player's pictures match exact renders, at rest and while the view moves.

    python -m tools.studies.player_psnr runs/street/compact.hyrf runs/bonsai/compact.hyrf --views 8 --enlarge 1 3

For cameras that each model stores, in pictures as large as the photos or --enlarge times as large, the table has the
mean and the worst PSNR in dB of the page of `hyrfpack export` against `render_view` without any approximation: at rest,
and as frames are drawn at a part of the resolution while the view moves, against the mean over blocks of the exact
render. The browser is headless Chromium.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

import hyrfpack
from hyrfpack.scene import Camera
from tools.browser.browser import Browser
from tools.browser.chromium import Chromium
from tools.studies.web_player import PAGE_TIMEOUT_SECONDS, draw_in_page, open_page, psnr, stored_cameras
from tools.tables import markdown_table

EXACT_SETTINGS = hyrfpack.RenderSettings(background_threshold=0, transmittance_min=0)
# From here on, pictures are drawn as a frame at a part of the resolution is, without what is added at rest. The
# panorama of the background has its final tiles in view, as after a rest at a view near this one.
MOVING_SCRIPT = """(() => {
  const { renderer } = hyrfpack.player, { content, read } = renderer, { complete } = content, scale = 1 / %d;
  content.complete = async function (view, ...rest) {
    await this.panorama?.complete(view, () => true);
    return complete.call(this, view, ...rest);
  };
  renderer.read = function ({ width, height, fx, fy, cx, cy, ...pose }, gains) {
    const [w, h, ...rest] = [width, height, fx, fy, cx, cy].map((value) => value * scale);
    return read.call(this, { ...pose, width: w, height: h, fx: rest[0], fy: rest[1], cx: rest[2], cy: rest[3], scale },
      gains);
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


def measure_page(browser: Browser, model: Path, views: int, factor: int, enlarge: int) -> list[str]:
    """Return the row of a model whose page is open."""
    cameras = [cut_camera(enlarge_camera(camera, enlarge), factor) for camera in stored_cameras(model, views)]
    field = hyrfpack.load_merged_model(model)
    exact = render_exact(field, cameras)
    still = [psnr(draw_in_page(browser, camera), picture) for camera, picture in zip(cameras, exact, strict=True)]
    browser.evaluate(MOVING_SCRIPT % factor)
    moving = []
    for camera, picture in zip(cameras, exact, strict=True):
        drawn = draw_in_page(browser, camera, reduction=factor)
        moving.append(psnr(drawn, reduce_picture(picture, factor)))
    cells = [f"{statistic(scores):.1f}" for scores in (still, moving) for statistic in (statistics.mean, min)]
    return [f"{model.parent.name}/{model.name}", f"{len(field):,}", str(enlarge), *cells]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", type=Path, nargs="+")
    parser.add_argument("--views", type=int, default=8, help="number of views of each model (8)")
    parser.add_argument("--factor", type=int, default=2, help="moving frames have 1/N of the resolution (2)")
    parser.add_argument("--enlarge", type=int, nargs="+", default=[1], help="sizes of pictures in sizes of photos (1)")
    arguments = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as folder, Chromium(timeout_seconds=PAGE_TIMEOUT_SECONDS) as browser:
        browser.resize(320, 200)  # pictures of cameras do not depend on the window
        for model in arguments.models:
            page = Path(folder) / "page.html"
            hyrfpack.export_model(model, page, overwrite=True)
            for enlarge in arguments.enlarge:
                open_page(browser, page)
                rows.append(measure_page(browser, model, arguments.views, arguments.factor, enlarge))
    print(markdown_table(["model", "Gaussians", "size", "still dB", "worst", "moving dB", "worst"], rows))


if __name__ == "__main__":
    main()

"""A picture at a reduced resolution, which moving uses, is nearly the reduced picture at full resolution."""

from __future__ import annotations

import base64
import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from web.native_models import encode_with_photos, make_model_page, random_model
from web.pages import Browser, make_splats_page, open_page, psnr, random_splats

pytestmark = pytest.mark.in_turn


def make_page_of_small_splats() -> bytes:
    splats = random_splats(6000, degree=1)
    return make_splats_page(replace(splats, scales=splats.scales * np.float32(0.2)))


def make_page_of_small_gaussians(**config: object) -> bytes:
    model = random_model(6000, **config)
    model.gaussians.scale_logits.data -= 3
    return make_model_page(model)


def make_page_of_small_photos() -> bytes:
    """Return a page whose window is larger than the photos of its model."""
    model = random_model(6000, antialiased=True)
    model.gaussians.scale_logits.data -= 3
    return make_model_page(model, encode_with_photos(model, background_stride=1))


PAGE_ENCODERS = {
    "splats": make_page_of_small_splats,
    "model": make_page_of_small_gaussians,
    "antialiased model": lambda: make_page_of_small_gaussians(antialiased=True),
    "model of small photos": make_page_of_small_photos,
}
# With 0.3 px^2 at every resolution, the first two pages have 25 and 31 dB at 0.5, and 16 and 24 dB at 0.2.
MIN_PSNR_BY_SCALE = {0.5: 45.0, 0.25: 38.0}


def capture(browser: Browser, scale: float) -> np.ndarray:
    """Return the window's picture, (H, W, 3) in 0 to 255, drawn at `scale` times its columns and twice that, or all, of
    its rows, and enlarged."""
    data = browser.evaluate(
        f"(hyrfpack.player.resolution = {scale}, hyrfpack.player.capture()).then((blob) => blob.arrayBuffer())"
        ".then((all) => btoa(Array.from(new Uint8Array(all), (byte) => String.fromCharCode(byte)).join('')))"
    )
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB"), np.float64)


def mean_over_blocks(picture: np.ndarray, height: int, width: int) -> np.ndarray:
    """Reduce a picture by the mean over blocks of whole pixels."""
    blocks = picture.reshape(height, picture.shape[0] // height, width, picture.shape[1] // width, 3)
    return blocks.mean((1, 3))


def enlarge(picture: np.ndarray, height: int, width: int) -> np.ndarray:
    """Enlarge a picture by bilinear interpolation between the centres of its pixels."""
    for axis, size in enumerate((height, width)):
        count = picture.shape[axis]
        place = np.clip((np.arange(size) + 0.5) * count / size - 0.5, 0, count - 1)
        first = np.minimum(place.astype(int), count - 2)
        share = (place - first).reshape([-1 if k == axis else 1 for k in range(3)])
        low, high = np.take(picture, first, axis), np.take(picture, first + 1, axis)
        picture = low + share * (high - low)
    return picture


@pytest.mark.parametrize("kind", PAGE_ENCODERS)
def test_a_coarse_picture_is_nearly_the_mean_over_blocks_of_the_fine_one(browser: Browser, tmp_path: Path, kind: str):
    open_page(browser, tmp_path, PAGE_ENCODERS[kind]())
    browser.evaluate("hyrfpack.player.settled.then(() => true)")
    fine = capture(browser, 1.0)
    height, width = fine.shape[:2]
    for scale, min_psnr in MIN_PSNR_BY_SCALE.items():
        reduced = mean_over_blocks(fine, round(min(1, 2 * scale) * height), round(scale * width))
        measured_psnr = psnr(capture(browser, scale), enlarge(reduced, height, width))
        assert measured_psnr > min_psnr, (scale, measured_psnr)

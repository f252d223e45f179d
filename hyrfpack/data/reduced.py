"""Reduces photos and their cameras by whole factors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hyrfpack.scene import Camera, Picture, View


def reduce_view(view: View, factor: int) -> View:
    """Return a view with a picture of 1/`factor` of its width and height.

    Views that are reduced by the same factor from the same view are equal, so a `PictureCache` keeps their picture.

    Args:
        view: the view. The last columns and rows of its picture are cut off where its size is no multiple of `factor`.
        factor: side of the square of pixels that becomes one pixel, at least 1 and at most the picture's shorter side;
            1 returns the view itself.
    """
    if factor == 1:
        return view
    return View(view.name, reduce_camera(view.camera, factor), _ReducedPhoto(view.load, factor))


def reduce_camera(camera: Camera, factor: int) -> Camera:
    """Return the camera of a picture of 1/`factor` of the width and height, rounded down.

    A pixel covers `factor` x `factor` pixels of the camera, starting from the top-left corner.
    """
    return Camera(
        camera.width // factor,
        camera.height // factor,
        camera.fx / factor,
        camera.fy / factor,
        camera.cx / factor,
        camera.cy / factor,
        camera.camera_from_world,
    )


def reduce_picture(picture: Picture, factor: int) -> Picture:
    """Return a picture whose pixels are the means of `factor` x `factor` pixels, rounded to bytes.

    Colours are weighted by alpha, so that the composite over any colour is the mean of the composites. A pixel is
    outside the mask if any of its pixels is.
    """
    mask = None if picture.mask is None else np.asarray(_blocks(picture.mask, factor).all(axis=(1, 3)))
    if picture.alpha is None:
        return Picture(_mean_of_blocks(picture.rgb, factor), None, mask)
    alpha = _blocks(picture.alpha, factor).astype(np.uint32)
    weights = alpha.sum(axis=(1, 3))
    colors = _blocks(picture.rgb, factor).astype(np.uint32) * alpha[..., None]
    rgb = colors.sum(axis=(1, 3)) / np.maximum(weights, 1)[..., None]
    return Picture(_to_bytes(rgb), _to_bytes(weights / factor**2), mask)


@dataclass(frozen=True)
class _ReducedPhoto:
    """Loads a photo and reduces it."""

    load: Callable[[], Picture]
    factor: int

    def __call__(self) -> Picture:
        return reduce_picture(self.load(), self.factor)


def _blocks(pixels: np.ndarray, factor: int) -> np.ndarray:
    """Return pixels (H, W, ...) as blocks (H / factor, factor, W / factor, factor, ...), without the remainder."""
    height, width = pixels.shape[0] // factor, pixels.shape[1] // factor
    cut = pixels[: height * factor, : width * factor]
    return cut.reshape(height, factor, width, factor, *pixels.shape[2:])


def _mean_of_blocks(pixels: np.ndarray, factor: int) -> np.ndarray:
    """Return the means of blocks of uint8 pixels, rounded to bytes."""
    number = np.uint16 if 255 * factor**2 + factor**2 // 2 < 2**16 else np.uint32  # The shorter one is faster.
    sums = _blocks(pixels, factor).sum(axis=1, dtype=number).sum(axis=2, dtype=number)
    return ((sums + number(factor**2 // 2)) // number(factor**2)).astype(np.uint8)


def _to_bytes(values: np.ndarray) -> np.ndarray:
    return (values + 0.5).astype(np.uint8)

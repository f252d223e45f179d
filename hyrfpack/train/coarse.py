"""Coarse to fine: photos at half their size in the first part of a run, where Gaussians only find their places."""

from __future__ import annotations

import dataclasses

from torch import Tensor

from hyrfpack.scene import Camera

SMALLEST = 64  # pixels that a side of a halved photo has at least


def can_be_halved(camera: Camera) -> bool:
    """Whether enough is left of its photo."""
    return min(camera.width, camera.height) >= 2 * SMALLEST


def halved(camera: Camera, photo: Tensor, mask: Tensor | None) -> tuple[Camera, Tensor, Tensor | None]:
    """A photo of half the size, each pixel the mean of four, and its camera. An odd row or column is left out.

    Args:
        camera: of the photo.
        photo: (H, W, 3).
        mask: (H, W) bool, True where a pixel counts; all when None.

    Returns:
        The camera of H // 2 x W // 2 pixels, the photo and the mask, in which a pixel counts where all four did.

    Example:
        >>> camera, photo, _ = halved(scene.train[0].camera, torch.rand(48, 64, 3), None)
        >>> photo.shape
        torch.Size([24, 32, 3])
    """
    height, width = camera.height // 2, camera.width // 2
    half = {name: getattr(camera, name) / 2 for name in ("fx", "fy", "cx", "cy")}
    small = photo[: 2 * height, : 2 * width].reshape(height, 2, width, 2, 3).mean((1, 3))
    if mask is not None:
        mask = mask[: 2 * height, : 2 * width].reshape(height, 2, width, 2).all(3).all(1)
    return dataclasses.replace(camera, width=width, height=height, **half), small, mask

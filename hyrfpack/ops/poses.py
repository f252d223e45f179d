"""What follows from a camera's pose alone."""

from __future__ import annotations

from torch import Tensor


def camera_center(pose: Tensor) -> Tensor:
    """Where a camera stands (3,), by its pose camera_from_world (4, 4): -R^T t."""
    return -(pose[:3, :3].T @ pose[:3, 3])

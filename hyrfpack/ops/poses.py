"""What follows from a camera's pose alone."""

from __future__ import annotations

from torch import Tensor


def camera_center(pose: Tensor) -> Tensor:
    """Where a camera stands (3,), by its pose camera_from_world (4, 4): -R^T t."""
    if pose.is_cuda:  # where a matrix product may be told to round its factors to 11 bits (TF32)
        return -(pose[:3, :3] * pose[:3, 3:]).sum(0)
    return -(pose[:3, :3].T @ pose[:3, 3])

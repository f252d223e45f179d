"""Computes quantities that depend on a camera's pose alone."""

from __future__ import annotations

from torch import Tensor


def camera_center(pose: Tensor) -> Tensor:
    """Return the centre (3,) of a camera in world coordinates, -R^T t, from its pose camera_from_world (4, 4)."""
    if pose.is_cuda:  # A matrix product could round its factors to 11 bits (TF32), if torch is set to allow that.
        return -(pose[:3, :3] * pose[:3, 3:]).sum(0)
    return -(pose[:3, :3].T @ pose[:3, 3])

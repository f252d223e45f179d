"""What follows from a camera's pose alone."""

from __future__ import annotations

import torch
from torch import Tensor


def rotate(vectors: Tensor, rotation: Tensor) -> Tensor:
    """R v of vectors v (..., 3) by a matrix R (3, 3).

    Not as a matrix product: where torch is told to make those quickly (`torch.set_float32_matmul_precision`), their
    factors are rounded to 11 bits or fewer, and cameras would stand and look elsewhere.
    """
    x, y, z = vectors.split(1, dim=-1)
    a, b, c = rotation.unbind(-1)
    return torch.addcmul(torch.addcmul(x * a, y, b), z, c)


def camera_center(pose: Tensor) -> Tensor:
    """Where a camera stands (3,), by its pose camera_from_world (4, 4): -R^T t."""
    return -rotate(pose[:3, 3], pose[:3, :3].T)

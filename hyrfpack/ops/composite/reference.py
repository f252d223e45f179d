"""Implements compositing in plain torch for any device and dtype. This reference defines the correct result."""

from __future__ import annotations

import torch
from torch import Tensor


def composite(rgb: Tensor, transmittance: Tensor, grid: Tensor, stride: int) -> Tensor:
    """Compute `hyrfpack.ops.composite.composite` with torch operations that autograd differentiates."""
    height, width = transmittance.shape
    background = _upsample(grid.permute(2, 0, 1), stride)[:, :height, :width].permute(1, 2, 0)
    return rgb + transmittance[..., None] * background


def _upsample(grid: Tensor, stride: int) -> Tensor:
    """Insert stride - 1 interpolated values between neighbouring nodes of a grid (C, R, S), along both axes."""
    if stride == 1:
        return grid
    size = ((grid.shape[1] - 1) * stride + 1, (grid.shape[2] - 1) * stride + 1)
    return torch.nn.functional.interpolate(grid[None], size, mode="bilinear", align_corners=True)[0]

"""Compositing in plain torch, any device and dtype: the definition of right."""

from __future__ import annotations

import torch
from torch import Tensor


def composite(rgb: Tensor, transmittance: Tensor, grid: Tensor, stride: int) -> Tensor:
    """As `hyrfpack.ops.composite.composite`."""
    height, width = transmittance.shape
    behind = _upsample(grid.permute(2, 0, 1), stride)[:, :height, :width].permute(1, 2, 0)
    return rgb + transmittance[..., None] * behind


def _upsample(grid: Tensor, stride: int) -> Tensor:
    """Every node of a grid (C, R, S) and stride - 1 values between it and the next, along both axes."""
    if stride == 1:
        return grid
    size = ((grid.shape[1] - 1) * stride + 1, (grid.shape[2] - 1) * stride + 1)
    return torch.nn.functional.interpolate(grid[None], size, mode="bilinear", align_corners=True)[0]

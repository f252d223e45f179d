"""A coarse grid of nodes, bilinearly interpolated to a node's distance and less."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable


def upsample(grid: Tensor, stride: int) -> Tensor:
    """Every node of a grid and stride - 1 values between it and the next, along both axes.

    On CUDA, torch's own gradient adds up by atomics, so that equal runs differ; here each node gathers what is its.

    Args:
        grid: (C, R, S).
        stride: at least 1.

    Returns:
        (C, (R - 1) * stride + 1, (S - 1) * stride + 1).

    Example:
        >>> upsample(torch.tensor([[[0.0, 1.0], [2.0, 3.0]]]), 2)[0].tolist()
        [[0.0, 0.5, 1.0], [1.0, 1.5, 2.0], [2.0, 2.5, 3.0]]
    """
    if stride == 1:
        return grid
    return _Gathered.apply(grid, stride) if grid.is_cuda else _interpolate(grid, stride)


def _interpolate(grid: Tensor, stride: int) -> Tensor:
    size = ((grid.shape[1] - 1) * stride + 1, (grid.shape[2] - 1) * stride + 1)
    return torch.nn.functional.interpolate(grid[None], size, mode="bilinear", align_corners=True)[0]


class _Gathered(torch.autograd.Function):
    """`_interpolate` with a gradient that has the same bits each time."""

    @staticmethod
    def forward(ctx, grid: Tensor, stride: int) -> Tensor:
        ctx.stride = stride
        return _interpolate(grid, stride)

    @staticmethod
    @once_differentiable
    def backward(ctx, grad: Tensor) -> tuple[Tensor, None]:
        return _gather(_gather(grad, ctx.stride).mT, ctx.stride).mT, None


def _gather(grad: Tensor, stride: int) -> Tensor:
    """Sums of the last axis over all that a node takes part in, each by its share: 1 at the node, 0 at the next."""
    reach = stride - 1
    steps = torch.arange(-reach, reach + 1, dtype=grad.dtype, device=grad.device)
    windows = torch.nn.functional.pad(grad, (reach, reach)).unfold(-1, 2 * stride - 1, stride)
    return (windows * (1 - steps.abs() / stride)).sum(-1)

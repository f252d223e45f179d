"""The explicit part of a model: eight numbers for each Gaussian."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

LOGIT_LIMIT = 12.0  # sigmoid is within 7e-6 of its ends there; beyond, gradients die


def logit(values: Tensor) -> Tensor:
    """The inverse of the sigmoid, clamped to +-LOGIT_LIMIT so that 0 and 1 stay finite and trainable."""
    edge = 1 / (1 + math.exp(LOGIT_LIMIT))
    values = values.double().clamp(edge, 1 - edge)
    return (values.log() - (-values).log1p()).float()


class Gaussians(nn.Module):
    """Positions and the explicit logits, one row for each Gaussian.

    Attributes:
        positions: (N, 3) local units.
        color_logits: (N, 3). scale_logits: (N, 1). opacity_logits: (N, 1).
    """

    NAMES = ("positions", "color_logits", "scale_logits", "opacity_logits")
    WIDTHS = (3, 3, 1, 1)
    positions: Tensor
    color_logits: Tensor
    scale_logits: Tensor
    opacity_logits: Tensor

    def __init__(self, positions: Tensor, color_logits: Tensor, scale_logits: Tensor, opacity_logits: Tensor) -> None:
        super().__init__()
        for name, width, values in zip(
            self.NAMES, self.WIDTHS, (positions, color_logits, scale_logits, opacity_logits), strict=True
        ):
            if values.shape != (len(positions), width):
                raise ValueError(f"{name} has shape {tuple(values.shape)}; ({len(positions)}, {width}) is needed")
            setattr(self, name, nn.Parameter(values.float().contiguous()))

    def __len__(self) -> int:
        return len(self.positions)


def take_rows(values: Tensor, index: Tensor) -> Tensor:
    """values[index], (n, C), for (n,) int64 in which no row comes twice; differentiable.

    Rows that are taken once need no sum: a copy is enough to pull a gradient back, where torch sorts the indices.
    """
    return _TakeRows.apply(values, index)


class _TakeRows(torch.autograd.Function):
    @staticmethod
    def forward(ctx, values: Tensor, index: Tensor) -> Tensor:
        ctx.save_for_backward(index)
        ctx.shape = values.shape
        return values.index_select(0, index)

    @staticmethod
    @once_differentiable
    def backward(ctx, grad: Tensor) -> tuple[Tensor, None]:
        (index,) = ctx.saved_tensors
        return grad.new_zeros(ctx.shape).index_copy_(0, index, grad), None

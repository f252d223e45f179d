"""Implements the multilayer perceptron in plain torch for any device and dtype.

This reference defines the correct result.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor


def mlp(x: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor], mixed: bool) -> Tensor:
    """Compute `hyrfpack.ops.mlp.mlp` with torch operations that autograd differentiates."""
    linear = _MixedLinear.apply if mixed else F.linear
    for weight, bias in zip(weights[:-1], biases[:-1], strict=True):
        x = F.relu(linear(x, weight, bias))
    return linear(x, weights[-1], biases[-1])


def round_to_bfloat16(values: Tensor) -> Tensor:
    """Round to the nearest bfloat16 and return the result in the dtype of the input."""
    return values.bfloat16().to(values.dtype)


class _MixedLinear(torch.autograd.Function):
    """Computes x W^T + b. Forward and backward round the factors of products to bfloat16, but not the sums."""

    @staticmethod
    def forward(ctx, x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        x, weight = round_to_bfloat16(x), round_to_bfloat16(weight)
        ctx.save_for_backward(x, weight)
        return F.linear(x, weight, bias)

    @staticmethod
    def backward(ctx, grad: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        x, weight = ctx.saved_tensors
        factor = round_to_bfloat16(grad)
        return factor @ weight, factor.T @ x, grad.sum(0)

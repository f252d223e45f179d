"""The multilayer perceptron in plain torch, any device and dtype: the definition of right."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor


def mlp(x: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor], mixed: bool) -> Tensor:
    """As `hyrfpack.ops.mlp.mlp`, differentiable by autograd alone."""
    linear = _MixedLinear.apply if mixed else F.linear
    for weight, bias in zip(weights[:-1], biases[:-1], strict=True):
        x = F.relu(linear(x, weight, bias))
    return linear(x, weights[-1], biases[-1])


def rounded(values: Tensor) -> Tensor:
    """The nearest bfloat16 numbers, in the type of the input."""
    return values.bfloat16().to(values.dtype)


class _MixedLinear(torch.autograd.Function):
    """x W^T + b whose products, here and in backward, take factors rounded to bfloat16; sums are not rounded."""

    @staticmethod
    def forward(ctx, x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        x, weight = rounded(x), rounded(weight)
        ctx.save_for_backward(x, weight)
        return F.linear(x, weight, bias)

    @staticmethod
    def backward(ctx, grad: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        x, weight = ctx.saved_tensors
        factor = rounded(grad)
        return factor @ weight, factor.T @ x, grad.sum(0)

"""A small multilayer perceptron over many rows: the decoder of a field."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from hyrfpack.ops.dispatch import choose
from hyrfpack.ops.mlp import reference

__all__ = ["mlp"]


def mlp(x: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor], *, implementation: str = "auto") -> Tensor:
    """Run rows through linear layers with ReLU between them and nothing after the last.

        h_0 = x,    h_l = relu(h_{l-1} W_l^T + b_l),    y = h_{L-1} W_L^T + b_L

    Args:
        x: (N, I) rows, in any memory layout; its gradient comes back in the same.
        weights: one (out, in) matrix for each layer, at least one.
        biases: one (out,) vector for each layer.
        implementation: "auto", "reference" or "cpu" (float32).

    Returns:
        (N, O). Differentiable once in everything. In the backward pass of "cpu", rows whose gradient is all zero
        are skipped.

    Raises:
        ValueError: shapes, types or devices do not fit together.
    """
    widths = [x.shape[-1], *(weight.shape[0] for weight in weights)]
    layers = zip(weights, widths, strict=False)
    if (
        x.ndim != 2
        or not weights
        or any(weight.ndim != 2 or weight.shape[1] != width for weight, width in layers)
        or [tuple(bias.shape) for bias in biases] != [(width,) for width in widths[1:]]
    ):
        shapes = [tuple(tensor.shape) for tensor in (x, *weights, *biases)]
        raise ValueError(f"x, weights and biases do not form layers: {shapes}")
    if choose(implementation, ("reference", "cpu"), x, *weights, *biases) == "reference":
        return reference.mlp(x, weights, biases)
    return _Mlp.apply(x, *weights, *biases)


class _Mlp(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x: Tensor, *parameters: Tensor) -> Tensor:
        from hyrfpack.ops.mlp import cpu

        ctx.save_for_backward(x, *parameters)
        layers = len(parameters) // 2
        return cpu.forward(x, parameters[:layers], parameters[layers:])

    @staticmethod
    @once_differentiable
    def backward(ctx, grad: Tensor) -> tuple[Tensor | None, ...]:
        from hyrfpack.ops.mlp import cpu

        x, *parameters = ctx.saved_tensors
        layers = len(parameters) // 2
        needs_x = ctx.needs_input_grad[0]
        grad_x, grad_weights, grad_biases = cpu.backward(x, parameters[:layers], parameters[layers:], grad, needs_x)
        return grad_x, *grad_weights, *grad_biases

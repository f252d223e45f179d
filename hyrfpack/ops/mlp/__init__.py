"""A small multilayer perceptron over many rows: the decoder of a field."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from hyrfpack.ops.dispatch import choose_implementation
from hyrfpack.ops.mlp import reference

__all__ = ["WIDEST", "mlp"]

WIDEST = 128  # inputs and hidden layers that GPU kernels take


def mlp(
    x: Tensor,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor],
    *,
    mixed: bool = False,
    implementation: str = "auto",
) -> Tensor:
    """Run rows through linear layers with ReLU between them and nothing after the last.

        h_0 = x,    h_l = relu(h_{l-1} W_l^T + b_l),    y = h_{L-1} W_L^T + b_L

    Args:
        x: (N, I) rows, in any memory layout; its gradient comes back in the same.
        weights: one (out, in) matrix for each layer, at least one.
        biases: one (out,) vector for each layer.
        mixed: products, here and in backward, take factors rounded to bfloat16 and are added up in float32: what the
            matrix units of a GPU are fast at. "cpu" multiplies in float32 whatever is asked.
        implementation: "auto", "reference", "cpu" or "gpu" (both float32). What the GPU kernels do not take - other
            than two hidden layers, inputs or hidden layers wider than 128, more than 16 outputs - runs as "reference".

    Returns:
        (N, O). Differentiable once in everything. In the backward pass of "cpu" rows whose gradient is all zero are
        skipped, in that of "gpu" blocks of such rows.

    Raises:
        ValueError: shapes, types or devices do not fit together.

    Example:
        >>> weights, biases = [torch.eye(2), torch.ones(1, 2)], [torch.zeros(2), torch.zeros(1)]
        >>> mlp(torch.tensor([[1.0, -3.0]]), weights, biases)
        tensor([[1.]])
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
    chosen = choose_implementation(implementation, ("reference", "cpu", "gpu"), x, *weights, *biases)
    if chosen == "cpu":
        return _CpuMlp.apply(x, *weights, *biases)
    if chosen == "gpu" and len(weights) == 3 and max(widths[:3]) <= WIDEST and widths[3] <= 16:
        return _GpuMlp.apply(x, mixed, *weights, *biases)
    return reference.mlp(x, weights, biases, mixed)


class _CpuMlp(torch.autograd.Function):
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


class _GpuMlp(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x: Tensor, mixed: bool, *parameters: Tensor) -> Tensor:
        from hyrfpack.ops.mlp import gpu

        weights, biases = parameters[:3], parameters[3:]
        result, packed = gpu.forward(x, weights, biases, mixed)
        ctx.save_for_backward(x, packed, *biases)
        ctx.mixed = mixed
        ctx.widths = x.shape[1], *(weight.shape[0] for weight in weights)
        return result

    @staticmethod
    @once_differentiable
    def backward(ctx, grad: Tensor) -> tuple[Tensor | None, ...]:
        from hyrfpack.ops.mlp import gpu

        x, packed, *biases = ctx.saved_tensors
        needs_x = ctx.needs_input_grad[0]
        grad_x, grad_weights, grad_biases = gpu.backward(x, packed, biases, ctx.widths, grad, needs_x, ctx.mixed)
        return grad_x, None, *grad_weights, *grad_biases

"""Evaluates a small multilayer perceptron on many rows, as the decoder of a field."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from hyrfpack.ops.dispatch import choose_implementation
from hyrfpack.ops.mlp import reference
from hyrfpack.ops.rows import clear_unused_rows

__all__ = ["MAX_GPU_LAYER_WIDTH", "mlp"]

# Widest input and hidden layers that the GPU kernels support.
MAX_GPU_LAYER_WIDTH = 128


def mlp(
    x: Tensor,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor],
    *,
    mixed: bool = False,
    used: Tensor | None = None,
    implementation: str = "auto",
) -> Tensor:
    """Apply linear layers with ReLU between them, and no activation after the last, to every row.

        h_0 = x,    h_l = relu(h_{l-1} W_l^T + b_l),    y = h_{L-1} W_L^T + b_L

    Args:
        x: (N, I) rows, in any memory layout; its gradient has the same layout.
        weights: one (out, in) matrix for each layer, at least one.
        biases: one (out,) vector for each layer.
        mixed: forward and backward round the factors of products to bfloat16 and sum in float32, which is fast on the
            matrix units of a GPU. "cpu" always multiplies in float32.
        used: the number of rows in use, see `hyrfpack.ops.rows`; None if all are.
        implementation: "auto", "reference", "cpu" or "gpu" (the last two take float32 only). The GPU kernels support
            two hidden layers, inputs and hidden layers of width 128 or less, and at most 16 outputs; otherwise "gpu"
            falls back to "reference".

    Returns:
        (N, O). Differentiable once in `x`, `weights` and `biases`. The backward pass of "cpu" skips rows whose gradient
        is all zero; that of "gpu" skips blocks of such rows.

    Raises:
        ValueError: shapes, dtypes or devices do not match.

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
    chosen = choose_implementation("mlp", implementation, ("reference", "cpu", "gpu"), x, *weights, *biases)
    if chosen == "gpu" and len(weights) == 3 and max(widths[:3]) <= MAX_GPU_LAYER_WIDTH and widths[3] <= 16:
        return _GpuMlp.apply(x, mixed, used, *weights, *biases)
    if used is not None:
        x = clear_unused_rows(x, used)
    if chosen == "cpu":
        y = _CpuMlp.apply(x, torch.is_grad_enabled(), *weights, *biases)
    else:
        y = reference.mlp(x, weights, biases, mixed)
    return y if used is None else clear_unused_rows(y, used)


def _split_parameters(parameters: Sequence[Tensor]) -> tuple[Sequence[Tensor], Sequence[Tensor]]:
    """Split the parameters into weights and biases."""
    layers = len(parameters) // 2
    return parameters[:layers], parameters[layers:]


class _CpuMlp(torch.autograd.Function):
    """Autograd function of `mlp` on the CPU."""

    @staticmethod
    def forward(ctx, x: Tensor, has_gradients: bool, *parameters: Tensor) -> Tensor:
        from hyrfpack.ops.mlp import cpu

        weights, biases = _split_parameters(parameters)
        # needs_input_grad is True for parameters even where no gradients are recorded.
        hidden = cpu.allocate_hidden(len(x), weights) if has_gradients and any(ctx.needs_input_grad) else []
        ctx.save_for_backward(x, *parameters)
        ctx.hidden = hidden
        return cpu.forward(x, weights, biases, hidden)

    @staticmethod
    @once_differentiable
    def backward(ctx, grad: Tensor) -> tuple[Tensor | None, ...]:
        from hyrfpack.ops.mlp import cpu

        x, *parameters = ctx.saved_tensors
        needs_x = ctx.needs_input_grad[0]
        grad_x, grad_weights, grad_biases = cpu.backward(x, *_split_parameters(parameters), ctx.hidden, grad, needs_x)
        return grad_x, None, *grad_weights, *grad_biases


class _GpuMlp(torch.autograd.Function):
    """Autograd function of `mlp` on a GPU."""

    @staticmethod
    def forward(ctx, x: Tensor, mixed: bool, used: Tensor | None, *parameters: Tensor) -> Tensor:
        from hyrfpack.ops.mlp import gpu

        weights, biases = parameters[:3], parameters[3:]
        result, packed = gpu.forward(x, weights, biases, mixed, used)
        ctx.save_for_backward(x, used, packed, *biases)
        ctx.mixed = mixed
        ctx.widths = x.shape[1], *(weight.shape[0] for weight in weights)
        return result

    @staticmethod
    @once_differentiable
    def backward(ctx, grad: Tensor) -> tuple[Tensor | None, ...]:
        from hyrfpack.ops.mlp import gpu

        x, used, packed, *biases = ctx.saved_tensors
        needs_x = ctx.needs_input_grad[0]
        grad_x, grad_weights, grad_biases = gpu.backward(x, packed, biases, ctx.widths, grad, needs_x, ctx.mixed, used)
        return grad_x, None, None, *grad_weights, *grad_biases

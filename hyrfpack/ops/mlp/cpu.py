"""Evaluates the multilayer perceptron on the CPU with torch's matrix products, one chunk of rows per thread at a time.

Chunk boundaries depend only on the number of rows, and partial sums are added in order, so the result does not depend
on the number of threads. Hidden activations never leave the cache: the backward pass recomputes them for rows with a
non-zero gradient. This costs no more than storing them for all rows, because touching new memory is slow.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from hyrfpack.parallel.pool import run_tasks, torch_on_one_thread

_MAX_ROWS_PER_CHUNK = 2048  # The activations of a chunk (0.5 MiB at width 64) then stay in the L2 cache.
_MIN_ROWS_PER_CHUNK = 256
# Above this ratio of rows without a gradient, gathering the other rows is faster than computing all of them.
_MIN_IDLE_ROW_RATIO = 0.1

_relu_backward = torch.ops.aten.threshold_backward.grad_input


def _chunk_edges(rows: int) -> list[tuple[int, int]]:
    """Return the start and stop row of each chunk."""
    size = min(_MAX_ROWS_PER_CHUNK, max(_MIN_ROWS_PER_CHUNK, -(-rows // 4)))
    return [(start, min(rows, start + size)) for start in range(0, rows, size)]


def _run_chunks(task: Callable[[int], None], count: int) -> None:
    """Run task(0) to task(count - 1) on the thread pool, with torch limited to one thread per task."""
    with torch_on_one_thread():
        run_tasks(task, count)


def _layer_inputs(x: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor]) -> list[Tensor]:
    """Return the input of each layer: x, then the ReLU output of every layer but the last."""
    inputs = [x]
    for weight, bias in zip(weights[:-1], biases[:-1], strict=True):
        inputs.append(torch.addmm(bias, inputs[-1], weight.T).relu_())
    return inputs


def forward(x: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor]) -> Tensor:
    """Compute the outputs (N, O) of rows (N, I)."""
    edges = _chunk_edges(x.shape[0])
    result = torch.empty(x.shape[0], weights[-1].shape[0])

    def task(chunk: int) -> None:
        start, stop = edges[chunk]
        with torch.no_grad():
            last = _layer_inputs(x[start:stop], weights, biases)[-1]
            torch.addmm(biases[-1], last, weights[-1].T, out=result[start:stop])

    _run_chunks(task, len(edges))
    return result


def backward(
    x: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor], grad: Tensor, needs_x: bool
) -> tuple[Tensor | None, list[Tensor], list[Tensor]]:
    """Compute the gradients of x, weights and biases from the gradient (N, O) of the outputs.

    The gradient of x has the layout of x; it is None unless `needs_x`.
    """
    edges = _chunk_edges(x.shape[0])
    grad_x = torch.empty_like(x) if needs_x else None
    grad_weights = [torch.empty(len(edges), *weight.shape) for weight in weights]
    grad_biases = [torch.empty(len(edges), *bias.shape) for bias in biases]

    def task(chunk: int) -> None:
        start, stop = edges[chunk]
        with torch.no_grad():
            rows, grads = x[start:stop], grad[start:stop]
            active = grads.any(dim=1).nonzero().squeeze(1)
            gathered = len(active) < (1 - _MIN_IDLE_ROW_RATIO) * (stop - start)
            if gathered:
                rows, grads = rows[active], grads[active]
            inputs = _layer_inputs(rows, weights, biases)
            for layer in reversed(range(len(weights))):
                torch.mm(grads.T, inputs[layer], out=grad_weights[layer][chunk])
                torch.sum(grads, dim=0, out=grad_biases[layer][chunk])
                if layer > 0:
                    grads = grads @ weights[layer]
                    _relu_backward(grads, inputs[layer], 0, grad_input=grads)
            if grad_x is not None and gathered:
                grad_x[start:stop].zero_().index_copy_(0, active, grads @ weights[0])
            elif grad_x is not None:
                torch.mm(grads, weights[0], out=grad_x[start:stop])

    _run_chunks(task, len(edges))
    return grad_x, [_sum_in_order(parts) for parts in grad_weights], [_sum_in_order(parts) for parts in grad_biases]


def _sum_in_order(parts: Tensor) -> Tensor:
    """Return the sum over the first axis, added in order."""
    total = torch.zeros(parts.shape[1:])
    for part in parts:
        total += part
    return total

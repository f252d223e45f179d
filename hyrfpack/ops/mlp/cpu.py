"""Evaluates the multilayer perceptron on the CPU with torch's matrix products, one chunk of rows per thread at a time.

Chunk boundaries depend only on the number of rows, and partial sums are added in order, so the result does not depend
on the number of threads. The forward pass stores the hidden activations that a backward pass will need, unless there
are so many rows that they would take too much memory. Then the backward pass recomputes them.
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

# Hidden activations of more rows are not stored; at width 64 and two hidden layers they would take 128 MiB.
MAX_STORED_ROWS = 1 << 18

_relu_backward = torch.ops.aten.threshold_backward.grad_input


def _chunk_edges(rows: int) -> list[tuple[int, int]]:
    """Return the start and stop row of each chunk."""
    size = min(_MAX_ROWS_PER_CHUNK, max(_MIN_ROWS_PER_CHUNK, -(-rows // 4)))
    return [(start, min(rows, start + size)) for start in range(0, rows, size)]


def _run_chunks(task: Callable[[int], None], count: int) -> None:
    """Run task(0) to task(count - 1) on the thread pool, with torch limited to one thread per task."""
    with torch_on_one_thread():
        run_tasks(task, count)


def allocate_hidden(rows: int, weights: Sequence[Tensor]) -> list[Tensor]:
    """Allocate the outputs (N, width) of each hidden layer, or return an empty list if there are too many rows."""
    return [torch.empty(rows, weight.shape[0]) for weight in weights[:-1]] if rows <= MAX_STORED_ROWS else []


def forward(x: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor], hidden: Sequence[Tensor] = ()) -> Tensor:
    """Compute the outputs (N, O) of rows (N, I).

    Args:
        hidden: receives the outputs of the hidden layers after ReLU, see `allocate_hidden`; empty if not needed.
    """
    edges = _chunk_edges(x.shape[0])
    result = torch.empty(x.shape[0], weights[-1].shape[0])

    def task(chunk: int) -> None:
        start, stop = edges[chunk]
        with torch.no_grad():
            last = _hidden_layers(x[start:stop], weights, biases, [layer[start:stop] for layer in hidden])[-1]
            torch.addmm(biases[-1], last, weights[-1].T, out=result[start:stop])

    _run_chunks(task, len(edges))
    return result


def _hidden_layers(
    x: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor], hidden: Sequence[Tensor] = ()
) -> list[Tensor]:
    """Return x and the outputs of each hidden layer after ReLU, which are written to `hidden` if that is not empty."""
    inputs = [x]
    for layer, (weight, bias) in enumerate(zip(weights[:-1], biases[:-1], strict=True)):
        out = hidden[layer] if hidden else x.new_empty(len(x), len(bias))
        inputs.append(torch.addmm(bias, inputs[-1], weight.T, out=out).relu_())
    return inputs


def backward(
    x: Tensor,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor],
    hidden: Sequence[Tensor],
    grad: Tensor,
    needs_x: bool,
) -> tuple[Tensor | None, list[Tensor], list[Tensor]]:
    """Compute the gradients of x, weights and biases from the gradient (N, O) of the outputs.

    The gradient of x has the layout of x; it is None unless `needs_x`.

    Args:
        hidden: what `forward` wrote; if empty, the hidden layers are computed again for rows with a gradient.
    """
    edges = _chunk_edges(x.shape[0])
    grad_x = torch.empty_like(x) if needs_x else None
    grad_weights = [torch.empty(len(edges), *weight.shape) for weight in weights]
    grad_biases = [torch.empty(len(edges), *bias.shape) for bias in biases]

    def task(chunk: int) -> None:
        start, stop = edges[chunk]
        with torch.no_grad():
            grads = grad[start:stop]
            inputs = [tensor[start:stop] for tensor in (x, *hidden)]
            active = grads.any(dim=1).nonzero().squeeze(1)
            gathered = len(active) < (1 - _MIN_IDLE_ROW_RATIO) * (stop - start)
            if gathered:
                # For contiguous rows, `index_select` takes a fifth of the time of indexing.
                grads, *inputs = (tensor.index_select(0, active) for tensor in (grads, *inputs))
            if not hidden:
                inputs = _hidden_layers(inputs[0], weights, biases)
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

"""The multilayer perceptron on the CPU: chunks of rows through torch's matrix products, one chunk a thread at a time.

Where the rows are cut depends on their number alone and partial sums are added in their order, so the result does
not depend on the number of threads. Hidden activations never leave the cache: the backward pass computes them
again, for the rows that have a gradient, which costs no more than storing them for all rows (fresh memory is dear).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from hyrfpack.parallel.pool import run_tasks, torch_on_one_thread

_MOST_ROWS, _LEAST_ROWS = 2048, 256  # a chunk's activations (0.5 MiB at width 64) stay in the second cache
_WORTH_SKIPPING = 0.1  # share of idle rows from which gathering the others is cheaper than computing all

_relu_backward = torch.ops.aten.threshold_backward.grad_input


def _chunk_edges(rows: int) -> list[tuple[int, int]]:
    """Where each chunk of the rows starts and stops."""
    size = min(_MOST_ROWS, max(_LEAST_ROWS, -(-rows // 4)))
    return [(start, min(rows, start + size)) for start in range(0, rows, size)]


def _run(task: Callable[[int], None], count: int) -> None:
    with torch_on_one_thread():
        run_tasks(task, count)


def _hidden(x: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor]) -> list[Tensor]:
    """What goes into each layer: x, then every layer's output after its ReLU, less the last."""
    inputs = [x]
    for weight, bias in zip(weights[:-1], biases[:-1], strict=True):
        inputs.append(torch.addmm(bias, inputs[-1], weight.T).relu_())
    return inputs


def forward(x: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor]) -> Tensor:
    """(N, I) rows -> (N, O)."""
    edges = _chunk_edges(x.shape[0])
    result = torch.empty(x.shape[0], weights[-1].shape[0])

    def task(chunk: int) -> None:
        start, stop = edges[chunk]
        with torch.no_grad():
            last = _hidden(x[start:stop], weights, biases)[-1]
            torch.addmm(biases[-1], last, weights[-1].T, out=result[start:stop])

    _run(task, len(edges))
    return result


def backward(
    x: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor], grad: Tensor, needs_x: bool
) -> tuple[Tensor | None, list[Tensor], list[Tensor]]:
    """(N, O) gradient of the result -> gradients of x (None unless needed; stored as x is), weights and biases."""
    edges = _chunk_edges(x.shape[0])
    grad_x = torch.empty_like(x) if needs_x else None
    grad_weights = [torch.empty(len(edges), *weight.shape) for weight in weights]
    grad_biases = [torch.empty(len(edges), *bias.shape) for bias in biases]

    def task(chunk: int) -> None:
        start, stop = edges[chunk]
        with torch.no_grad():
            rows, grads = x[start:stop], grad[start:stop]
            active = grads.any(dim=1).nonzero().squeeze(1)
            gathered = len(active) < (1 - _WORTH_SKIPPING) * (stop - start)
            if gathered:
                rows, grads = rows[active], grads[active]
            inputs = _hidden(rows, weights, biases)
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

    _run(task, len(edges))
    return grad_x, [_total(parts) for parts in grad_weights], [_total(parts) for parts in grad_biases]


def _total(parts: Tensor) -> Tensor:
    """Sum over the first axis, in order."""
    total = torch.zeros(parts.shape[1:])
    for part in parts:
        total += part
    return total

"""Shading on the CPU: chunks of Gaussians through torch's matrix products, one chunk a thread at a time.

What is worked out of a chunk never leaves the cache: neither encoded directions nor hidden layers are written for all.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from hyrfpack.ops.shade.directions import encode_views
from hyrfpack.parallel.pool import run_tasks, torch_on_one_thread

if TYPE_CHECKING:
    from hyrfpack.ops.shade import Shading

_ROWS = 2048  # of a chunk: its hidden layers (0.5 MiB at width 64) stay in the second cache


def shade(positions: Tensor, viewpoint: Tensor, shading: Shading, index: Tensor | None) -> Tensor:
    """As `hyrfpack.ops.shade.shade`."""
    total = len(positions) if index is None else len(index)
    colors = torch.empty(total, 3)
    (w2, w3), (b2, b3) = shading.weights, shading.biases

    def task(chunk: int) -> None:
        some = slice(chunk * _ROWS, min(total, (chunk + 1) * _ROWS))

        def take(values: Tensor) -> Tensor:
            return values[some] if index is None else values.index_select(0, index[some])

        with torch.no_grad():
            encoded = encode_views(take(positions), viewpoint, shading.encoding, implementation="reference")
            hidden = torch.addmm(take(shading.first_layer), encoded, shading.direction_weight.T).relu_()
            hidden = torch.addmm(b2, hidden, w2.T).relu_()
            logits = torch.addmm(b3, hidden, w3.T).add_(take(shading.color_logits))
            torch.sigmoid(logits, out=colors[some])

    with torch_on_one_thread():
        run_tasks(task, -(-total // _ROWS))
    return colors

"""Shades Gaussians on the CPU with torch's matrix products, one chunk of Gaussians per thread at a time.

Encoded directions and hidden layers exist only for the chunks in progress and never leave the cache.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from hyrfpack.ops.shade.cpu_directions import encode_views
from hyrfpack.parallel.pool import run_tasks, torch_on_one_thread

if TYPE_CHECKING:
    from hyrfpack.ops.shade import Shading

_GAUSSIANS_PER_CHUNK = 2048  # The hidden layers of a chunk (0.5 MiB at width 64) then stay in the L2 cache.


def shade(positions: Tensor, viewpoint: Tensor, shading: Shading, index: Tensor | None) -> Tensor:
    """Compute the colours of `hyrfpack.ops.shade.shade`."""
    total = len(positions) if index is None else len(index)
    colors = torch.empty(total, 3)
    (w2, w3), (b2, b3) = shading.weights, shading.biases

    def shade_chunk(chunk: int) -> None:
        chunk_slice = slice(chunk * _GAUSSIANS_PER_CHUNK, min(total, (chunk + 1) * _GAUSSIANS_PER_CHUNK))

        def take(values: Tensor) -> Tensor:
            return values[chunk_slice] if index is None else values.index_select(0, index[chunk_slice])

        with torch.no_grad():
            encoded = encode_views(take(positions), viewpoint, shading.encoding, threaded=False)
            hidden = torch.addmm(take(shading.first_layer), encoded, shading.direction_weight.T).relu_()
            hidden = torch.addmm(b2, hidden, w2.T).relu_()
            logits = torch.addmm(b3, hidden, w3.T).add_(take(shading.color_logits))
            torch.sigmoid(logits, out=colors[chunk_slice])

    with torch_on_one_thread():
        run_tasks(shade_chunk, -(-total // _GAUSSIANS_PER_CHUNK))
    return colors

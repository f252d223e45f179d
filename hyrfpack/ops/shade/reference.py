"""Implements shading in plain torch for any device and dtype. This reference defines the correct result."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
import torch.nn.functional as F
from torch import Tensor

from hyrfpack.ops.mlp import mlp
from hyrfpack.ops.shade.directions import encode_views

if TYPE_CHECKING:
    from hyrfpack.ops.shade import Shading


def shade(positions: Tensor, viewpoint: Tensor, shading: Shading) -> Tensor:
    """Compute the colours of `hyrfpack.ops.shade.shade`."""
    encoded = encode_views(positions, viewpoint, shading.encoding, implementation="reference")
    # The direction's part of the first layer is a linear layer by itself, so `mlp` rounds its factors in the same way.
    by_direction = mlp(encoded, [shading.direction_weight], [torch.zeros_like(shading.direction_weight[:, 0])],
                       mixed=shading.mixed, implementation="reference")  # fmt: skip
    first = F.relu(shading.first_layer.to(positions.dtype) + by_direction)
    rest = mlp(first, shading.weights, shading.biases, mixed=shading.mixed, implementation="reference")
    return torch.sigmoid(rest + shading.color_logits)

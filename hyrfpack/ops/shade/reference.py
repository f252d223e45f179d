"""Shading in plain torch, any device and dtype: the definition of right."""

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
    """As `hyrfpack.ops.shade.shade`."""
    encoded = encode_views(positions, viewpoint, shading.encoding, implementation="reference")
    # The first layer's rest is a layer of its own without a ReLU before it: its product is of the same kind.
    by_direction = mlp(encoded, [shading.direction_weight], [torch.zeros_like(shading.direction_weight[:, 0])],
                       mixed=shading.mixed, implementation="reference")  # fmt: skip
    first = F.relu(shading.first_layer.to(positions.dtype) + by_direction)
    rest = mlp(first, shading.weights, shading.biases, mixed=shading.mixed, implementation="reference")
    return torch.sigmoid(rest + shading.color_logits)

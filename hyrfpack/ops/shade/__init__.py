"""Shading: the view-dependent colours of Gaussians, from what of the colour decoder does not depend on the view."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from hyrfpack.ops.dispatch import choose_implementation
from hyrfpack.ops.mlp import WIDEST
from hyrfpack.ops.shade import reference
from hyrfpack.ops.shade.directions import (
    DIRECTION_FEATURES,
    FREQUENCY_OCTAVES,
    encode_directions,
    encode_views,
    frequency_encoding,
    spherical_harmonics,
)

__all__ = [
    "DIRECTION_FEATURES",
    "FREQUENCY_OCTAVES",
    "Shading",
    "check_shading",
    "choose_for",
    "encode_directions",
    "encode_views",
    "frequency_encoding",
    "shade",
    "spherical_harmonics",
]


@dataclass(frozen=True)
class Shading:
    """The colour decoder as far as one model's Gaussians decide it. Nothing is differentiable.

    Its first layer reads hash features of the place and an encoded direction; the part of the place, with the bias,
    is worked out once.

    Attributes:
        first_layer: (N, H) contiguous, W1 features + b1 before the ReLU; float32, or bfloat16 when mixed.
        direction_weight: (H, E) the first layer's columns for the encoded direction.
        weights, biases: of the layers after it: (H2, H), (H2,), then (3, H2), (3,).
        color_logits: (N, 3) the explicit ones, added to the decoder's.
        encoding: "frequency" (E = 24) or "sh" (E = 9), see `encode_directions`.
        mixed: products take factors rounded to bfloat16, as in `hyrfpack.ops.mlp`.
    """

    first_layer: Tensor
    direction_weight: Tensor
    weights: tuple[Tensor, Tensor]
    biases: tuple[Tensor, Tensor]
    color_logits: Tensor
    encoding: str
    mixed: bool

    def part(self, index: Tensor) -> Shading:
        """The decoder of the Gaussians at `index` (n,) int64."""
        return replace(self, first_layer=self.first_layer[index], color_logits=self.color_logits[index])

    @cached_property
    def operands(self) -> tuple[tuple[Tensor, ...], dict]:
        """What GPU kernels take of it, packed once for all views: tensors, and constants by name."""
        from hyrfpack.ops.shade import gpu

        return gpu.operands(self)


def check_shading(shading: Shading, count: int) -> None:
    """Raise ValueError unless it is a decoder for so many Gaussians."""
    rows, hidden = shading.first_layer.shape
    widths = [tuple(weight.shape) for weight in (shading.direction_weight, *shading.weights)]
    features = DIRECTION_FEATURES.get(shading.encoding)
    fits = len(widths) == 3 and widths == [(hidden, features), (widths[1][0], hidden), (3, widths[1][0])]
    if not fits or rows != count or shading.color_logits.shape != (count, 3):
        raise ValueError(
            f"first layer {(rows, hidden)}, {shading.encoding} encoding, weights {widths} and color logits "
            f"{tuple(shading.color_logits.shape)} do not form a decoder for {count} Gaussians"
        )


def choose_for(
    shading: Shading, implementation: str, *tensors: Tensor, available: tuple[str, ...] = ("reference", "gpu")
) -> str:
    """As `dispatch.choose_implementation`, for kernels that take these tensors and a shading."""
    parameters = (shading.direction_weight, *shading.weights, *shading.biases, shading.color_logits)
    if max(weight.shape[1] for weight in shading.weights) > WIDEST:
        available = tuple(name for name in available if name != "gpu")
    if shading.mixed:
        available = tuple(name for name in available if name != "cpu")
    return choose_implementation(implementation, available, *tensors, *parameters)


@torch.no_grad()
def shade(
    positions: Tensor,
    viewpoint: Tensor,
    shading: Shading,
    index: Tensor | None = None,
    *,
    implementation: str = "auto",
) -> Tensor:
    """Colours of Gaussians seen from a point.

        d = (p - o) / |p - o|,   h1 = relu(first_layer + W1' e(d)),   h2 = relu(W2 h1 + b2)
        color = sigmoid(W3 h2 + b3 + color_logits)

    Args:
        positions: (N, 3) p.
        viewpoint: (3,) o, in the same units.
        shading: of these N Gaussians.
        index: (n,) int64 which of them; all when None.
        implementation: "auto", "reference", "cpu" (float32, not mixed) or "gpu" (float32, two hidden layers of at
            most 128).

    Returns:
        (n, 3) in (0, 1). Not differentiable.

    Raises:
        ValueError: shapes, types or devices do not fit together.
    """
    check_shading(shading, len(positions))
    if positions.shape != (len(positions), 3) or viewpoint.shape != (3,):
        raise ValueError(f"{tuple(positions.shape)} positions and viewpoint {tuple(viewpoint.shape)}, not (N, 3), (3,)")
    available = ("reference", "cpu", "gpu")
    chosen = choose_for(shading, implementation, positions, viewpoint, available=available)
    if chosen == "cpu":
        from hyrfpack.ops.shade import cpu

        return cpu.shade(positions, viewpoint, shading, index)
    if index is not None:
        positions, shading = positions[index], shading.part(index)
    if chosen == "gpu":
        from hyrfpack.ops.shade import gpu

        return gpu.shade(positions, viewpoint, shading)
    return reference.shade(positions, viewpoint, shading)

"""Shades Gaussians: computes their view-dependent colours from parts of the colour decoder precomputed once."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from hyrfpack.ops.dispatch import choose_implementation
from hyrfpack.ops.mlp import MAX_GPU_LAYER_WIDTH
from hyrfpack.ops.shade import reference
from hyrfpack.ops.shade.directions import (
    DIRECTION_FEATURES,
    FREQUENCY_OCTAVES,
    encode_directions,
    encode_views,
    frequency_encoding,
    spherical_harmonics,
)

if TYPE_CHECKING:
    from hyrfpack.ops.shade.gpu import DecoderTensors

__all__ = [
    "DIRECTION_FEATURES",
    "FREQUENCY_OCTAVES",
    "Shading",
    "check_shading",
    "choose_shading_implementation",
    "encode_directions",
    "encode_views",
    "frequency_encoding",
    "shade",
    "spherical_harmonics",
]


@dataclass(frozen=True)
class Shading:
    """The colour decoder with the view-independent part precomputed for one model's Gaussians. Not differentiable.

    The decoder's first layer reads the hash features of a position and an encoded direction. The position's part of
    its output, including the bias, is the same for all views and is computed once.

    Attributes:
        first_layer: (N, H) contiguous, W1 features + b1 before the ReLU; float32, or bfloat16 if mixed.
        direction_weight: (H, E) the first layer's columns for the encoded direction.
        weights, biases: of the second and third layer: (H2, H), (H2,), then (3, H2), (3,).
        color_logits: (N, 3) explicit colour logits, added to the decoder's outputs.
        encoding: "frequency" (E = 24) or "sh" (E = 9), see `encode_directions`.
        mixed: whether the factors of products are rounded to bfloat16, as in `hyrfpack.ops.mlp`.
    """

    first_layer: Tensor
    direction_weight: Tensor
    weights: tuple[Tensor, Tensor]
    biases: tuple[Tensor, Tensor]
    color_logits: Tensor
    encoding: str
    mixed: bool

    def subset(self, index: Tensor) -> Shading:
        """Return the decoder of the Gaussians at `index` (n,) int64."""
        return replace(self, first_layer=self.first_layer[index], color_logits=self.color_logits[index])

    @cached_property
    def kernel_arguments(self) -> tuple[DecoderTensors, dict[str, Any]]:
        """The tensors and named constants that GPU kernels take, packed once for all views."""
        from hyrfpack.ops.shade import gpu

        return gpu.kernel_arguments(self)


def check_shading(shading: Shading, count: int) -> None:
    """Raise ValueError unless the shapes of `shading` form a decoder for `count` Gaussians."""
    rows, hidden = shading.first_layer.shape
    widths = [tuple(weight.shape) for weight in (shading.direction_weight, *shading.weights)]
    features = DIRECTION_FEATURES.get(shading.encoding)
    fits = len(widths) == 3 and widths == [(hidden, features), (widths[1][0], hidden), (3, widths[1][0])]
    if not fits or rows != count or shading.color_logits.shape != (count, 3):
        raise ValueError(
            f"first layer {(rows, hidden)}, {shading.encoding} encoding, weights {widths} and color logits "
            f"{tuple(shading.color_logits.shape)} do not form a decoder for {count} Gaussians"
        )


def choose_shading_implementation(
    operation: str,
    shading: Shading,
    implementation: str,
    *tensors: Tensor,
    available: tuple[str, ...] = ("reference", "gpu"),
) -> str:
    """Choose the implementation that runs on these tensors and a shading, see `dispatch.choose_implementation`."""
    parameters = (shading.direction_weight, *shading.weights, *shading.biases, shading.color_logits)
    if max(weight.shape[1] for weight in shading.weights) > MAX_GPU_LAYER_WIDTH:
        available = tuple(name for name in available if name != "gpu")
    if shading.mixed:
        available = tuple(name for name in available if name != "cpu")
    return choose_implementation(operation, implementation, available, *tensors, *parameters)


@torch.no_grad()
def shade(
    positions: Tensor,
    viewpoint: Tensor,
    shading: Shading,
    index: Tensor | None = None,
    *,
    implementation: str = "auto",
) -> Tensor:
    """Compute the colours of Gaussians seen from a viewpoint.

        d = (p - o) / |p - o|,   h1 = relu(first_layer + W1' e(d)),   h2 = relu(W2 h1 + b2)
        color = sigmoid(W3 h2 + b3 + color_logits)

    Args:
        positions: (N, 3) p.
        viewpoint: (3,) o, in the same units.
        shading: the decoder of these N Gaussians.
        index: (n,) int64, the Gaussians to shade; None shades all.
        implementation: "auto", "reference", "cpu" (float32, not mixed) or "gpu" (float32, two hidden layers of width
            128 or less).

    Returns:
        (n, 3) in (0, 1). Not differentiable.

    Raises:
        ValueError: shapes, dtypes or devices do not match.
    """
    check_shading(shading, len(positions))
    if positions.shape != (len(positions), 3) or viewpoint.shape != (3,):
        raise ValueError(f"{tuple(positions.shape)} positions and viewpoint {tuple(viewpoint.shape)}, not (N, 3), (3,)")
    available = ("reference", "cpu", "gpu")
    chosen = choose_shading_implementation("shade", shading, implementation, positions, viewpoint, available=available)
    if chosen == "cpu":
        from hyrfpack.ops.shade import cpu

        return cpu.shade(positions, viewpoint, shading, index)
    if index is not None:
        positions, shading = positions[index], shading.subset(index)
    if chosen == "gpu":
        from hyrfpack.ops.shade import gpu

        return gpu.shade(positions, viewpoint, shading)
    return reference.shade(positions, viewpoint, shading)

"""Renders the background: a sphere around the scene that the radiance field colours, visible where light passes."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from hyrfpack.ops.background import reference
from hyrfpack.ops.background.reference import (
    BACKGROUND_RADIUS,
    BackgroundField,
    background_colors,
    grid_size,
    pixel_directions,
    sphere_points,
)
from hyrfpack.ops.dispatch import choose_implementation
from hyrfpack.ops.mlp import MAX_GPU_LAYER_WIDTH
from hyrfpack.ops.shade.directions import DIRECTION_FEATURES
from hyrfpack.ops.viewport import Viewport

__all__ = [
    "BACKGROUND_RADIUS",
    "BackgroundField",
    "background_colors",
    "background_grid",
    "grid_size",
    "pixel_directions",
    "sphere_points",
]


def background_grid(
    transmittance: Tensor,
    viewport: Viewport,
    field: BackgroundField,
    *,
    threshold: float,
    stride: int,
    implementation: str = "auto",
) -> Tensor:
    """Compute the colours of the background sphere at every stride-th pixel of both axes, where light passes.

    The ray of a node leaves the sphere at p along the unit vector d:

        color = sigmoid(mlp([hash_encode(contract(p / half_extent)), e(d)]))

    Nodes lie at the centres of pixels 0, stride, 2 stride, ..., the last at or past the image's edge. Pixels nearer to
    a node than `stride` in both axes interpolate from it. A node is needed if the transmittance exceeds `threshold` at
    any of these pixels.

    Args:
        transmittance: (H, W) the share of light that passes all Gaussians; it receives no gradient.
        viewport: the camera, in local units.
        field: the radiance field.
        threshold: the transmittance above which a pixel needs the background, 0 or more.
        stride: pixels between neighbouring nodes, at least 1.
        implementation: "auto", "reference", "cpu" (float32) or "gpu" (float32, two features per level, at most 16
            levels, two hidden layers of width 128 or less). Without gradients "gpu" is one launch.

    Returns:
        (rows, columns, 3) in (0, 1), see `grid_size`; 0 at nodes that are not needed, NaN where the field is NaN.
        Differentiable in the field's parameters.

    Raises:
        ValueError: shapes, sizes, dtypes or devices do not match.
    """
    table, weights, encoding = field.table, field.weights, field.encoding
    features = len(field.resolutions) * table.shape[-1] + DIRECTION_FEATURES.get(encoding, 0)
    if transmittance.shape != (viewport.height, viewport.width) or not stride >= 1:
        raise ValueError(
            f"transmittance {tuple(transmittance.shape)} of a picture of {viewport.width} x {viewport.height} and "
            f"stride {stride} make no grid"
        )
    if encoding not in DIRECTION_FEATURES or weights[0].shape[-1] != features or weights[-1].shape[0] != 3:
        raise ValueError(
            f"weights {[tuple(weight.shape) for weight in weights]} do not take {features} features, with directions "
            f"encoded as '{encoding}', to 3 outputs"
        )
    parameters = (table, *weights, *field.biases)
    is_gpu_supported = table.shape[1] == 2 and len(field.resolutions) <= 16 and len(weights) == 3
    is_gpu_supported = is_gpu_supported and max(weight.shape[0] for weight in weights) <= MAX_GPU_LAYER_WIDTH
    needs_grad = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in parameters)
    available = ("reference", "cpu", "gpu") if is_gpu_supported else ("reference", "cpu")
    run: Callable[..., Tensor] = reference.background_grid
    chosen = choose_implementation("background_grid", implementation, available, transmittance, *parameters)
    if chosen == "gpu":
        from hyrfpack.ops.background import gpu

        run = gpu.differentiable_grid if needs_grad else gpu.background_grid
    elif chosen == "cpu":
        from hyrfpack.ops.background import cpu

        run = partial(cpu.background_grid, needs_grad=needs_grad)
    return run(transmittance, viewport, field, threshold=threshold, stride=stride)

"""Renders the background: a sphere around the scene that the radiance field colours, visible where light passes."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from hyrfpack.ops.background import reference
from hyrfpack.ops.background.reference import (
    BACKGROUND_RADIUS,
    background_colors,
    grid_size,
    pixel_directions,
    sphere_points,
)
from hyrfpack.ops.dispatch import choose_implementation
from hyrfpack.ops.mlp import MAX_GPU_LAYER_WIDTH
from hyrfpack.ops.shade.directions import DIRECTION_FEATURES

__all__ = [
    "BACKGROUND_RADIUS",
    "background_colors",
    "background_grid",
    "grid_size",
    "pixel_directions",
    "sphere_points",
]


def background_grid(
    transmittance: Tensor,
    *,
    threshold: float,
    stride: int,
    pose: Tensor,
    intrinsics: tuple[float, float, float, float],
    half_extent: tuple[float, float, float],
    table: Tensor,
    resolutions: tuple[int, ...],
    log2_table_size: int,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor],
    encoding: str,
    mixed: bool = False,
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
        threshold: the transmittance above which a pixel needs the background, 0 or more.
        stride: pixels between neighbouring nodes, at least 1.
        pose: (4, 4) camera_from_local, preferably on the CPU, where "gpu" reads it. Not differentiable.
        intrinsics: (fx, fy, cx, cy) in pixels.
        half_extent: half-axes of the box that the contraction maps linearly, local units.
        table, resolutions, log2_table_size: the radiance field's hash grid, as in `hash_encode`.
        weights, biases: the radiance field's decoder, as in `mlp`; three outputs.
        encoding: the encoding of d, "frequency" or "sh", see `encode_directions`.
        mixed: as in `mlp`.
        implementation: "auto", "reference" or "gpu" (float32, two features per level, at most 16 levels, two hidden
            layers of width 128 or less). Without gradients "gpu" is one launch; with gradients it synchronises with
            the device once.

    Returns:
        (rows, columns, 3) in (0, 1), see `grid_size`; 0 at nodes that are not needed, NaN where the field is NaN.
        Differentiable in the field's parameters.

    Raises:
        ValueError: shapes, sizes, dtypes or devices do not match.
    """
    features = len(resolutions) * table.shape[-1] + DIRECTION_FEATURES.get(encoding, 0)
    if transmittance.ndim != 2 or not transmittance.numel() or pose.shape != (4, 4) or not stride >= 1:
        raise ValueError(
            f"transmittance {tuple(transmittance.shape)}, pose {tuple(pose.shape)} and stride {stride} make no grid"
        )
    if encoding not in DIRECTION_FEATURES or weights[0].shape[-1] != features or weights[-1].shape[0] != 3:
        raise ValueError(
            f"weights {[tuple(weight.shape) for weight in weights]} do not take {features} features, with directions "
            f"encoded as '{encoding}', to 3 outputs"
        )
    field = (table, *weights, *biases)
    is_gpu_supported = table.shape[1] == 2 and len(resolutions) <= 16 and len(weights) == 3
    is_gpu_supported = is_gpu_supported and max(weight.shape[0] for weight in weights) <= MAX_GPU_LAYER_WIDTH
    needs_grad = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in field)
    available = ("reference", "gpu") if is_gpu_supported else ("reference",)
    run: Callable[..., Tensor] = reference.background_grid
    if choose_implementation(implementation, available, transmittance, *field) == "gpu":
        from hyrfpack.ops.background import gpu

        run = gpu.differentiable_grid if needs_grad else gpu.background_grid
    return run(
        transmittance,
        threshold=threshold,
        stride=stride,
        pose=pose,
        intrinsics=intrinsics,
        half_extent=half_extent,
        table=table,
        resolutions=resolutions,
        log2_table_size=log2_table_size,
        weights=weights,
        biases=biases,
        encoding=encoding,
        mixed=mixed,
    )

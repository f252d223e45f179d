"""The background: a sphere around the scene, coloured by the radiance field, seen where light is left."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from hyrfpack.ops.background import reference
from hyrfpack.ops.background.reference import (
    RADIUS,
    background_colors,
    grid_size,
    pixel_directions,
    sphere_points,
)
from hyrfpack.ops.dispatch import choose_implementation
from hyrfpack.ops.mlp import WIDEST
from hyrfpack.ops.shade.directions import DIRECTION_FEATURES

__all__ = [
    "RADIUS",
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
    """Colours of the background sphere at every stride-th pixel of both axes, where light comes through.

    A node's ray leaves the sphere at p, seen along the unit vector d:

        color = sigmoid(mlp([hash_encode(contract(p / half_extent)), e(d)]))

    Nodes lie at the centres of pixels 0, stride, 2 stride, ..., the last at or past the picture's edge. A node is
    needed when more light than `threshold` passes at any pixel nearer to it than `stride` in both axes: those that
    take part of their colour from it.

    Args:
        transmittance: (H, W) the share of light that passes all Gaussians; nothing flows back to it.
        threshold: of transmittance, not negative.
        stride: pixels from node to node, at least 1.
        pose: (4, 4) camera_from_local, best on the CPU: "gpu" reads it there. Not differentiable.
        intrinsics: (fx, fy, cx, cy) in pixels.
        half_extent: half-axes of the box that the contraction leaves alone, local units.
        table, resolutions, log2_table_size: the radiance field's hash grid, as in `hash_encode`.
        weights, biases: its decoder, as in `mlp`; three outputs.
        encoding: of d, "frequency" or "sh", see `encode_directions`.
        mixed: as in `mlp`.
        implementation: "auto", "reference" or "gpu" (float32, two features a level, at most 16 levels, two hidden
            layers of at most 128). "gpu" takes one launch where no gradient is wanted, and waits for the device once
            where one is.

    Returns:
        (rows, columns, 3) in (0, 1), see `grid_size`; 0 at nodes that are not needed. Where
        the field says NaN, the colour is NaN. Differentiable in the field's parameters.

    Raises:
        ValueError: shapes, sizes, types or devices do not fit together.
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
    fits = table.shape[1] == 2 and len(resolutions) <= 16 and len(weights) == 3
    fits = fits and max(weight.shape[0] for weight in weights) <= WIDEST
    wanted = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in field)
    available = ("reference", "gpu") if fits else ("reference",)
    run: Callable[..., Tensor] = reference.background_grid
    if choose_implementation(implementation, available, transmittance, *field) == "gpu":
        from hyrfpack.ops.background import gpu

        run = gpu.learnable_grid if wanted else gpu.background_grid
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

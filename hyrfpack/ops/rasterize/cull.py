"""Which Gaussians are worth decoding for a viewpoint (HyRF's visibility pre-culling)."""

from __future__ import annotations

import torch
from torch import Tensor

from hyrfpack.ops.dispatch import choose_implementation
from hyrfpack.ops.finite import all_finite


def frustum_cull(
    positions: Tensor,
    pose: Tensor,
    intrinsics: tuple[float, float, float, float],
    width: int,
    height: int,
    near: float,
    tolerance: float,
    *,
    implementation: str = "auto",
) -> Tensor:
    """Indices of the points in front of the near plane that project into the picture or a band around it.

    Args:
        positions: (N, 3) local units.
        pose: (4, 4) camera_from_local, best on the CPU: "gpu" reads it there.
        intrinsics: (fx, fy, cx, cy) in pixels.
        near: smallest depth kept (exclusive), local units.
        tolerance: width of the band as a fraction of half the picture's width and height (NDC units).
        implementation: "auto", "reference" or "gpu" (float32 positions; works in float64).

    Returns:
        (n,) int64, ascending.

    Raises:
        FloatingPointError: a position is NaN or infinite; by comparisons alone it would be left out without a word.
        ValueError: the implementation cannot take these positions.
    """
    if choose_implementation(implementation, ("reference", "gpu"), positions) == "gpu":
        from hyrfpack.ops.rasterize import gpu_cull

        return gpu_cull.frustum_cull(positions, pose, intrinsics, width, height, near, tolerance)
    if not all_finite(positions):
        raise FloatingPointError("positions hold NaN or infinity")
    pose = pose.to(positions)
    fx, fy, cx, cy = intrinsics
    x, y, z = (positions @ pose[:3, :3].T + pose[:3, 3]).unbind(-1)
    margin_x, margin_y = tolerance * width / 2, tolerance * height / 2
    u, v = fx * x, fy * y  # compared after multiplying by z > 0: no division, nothing to guard
    inside = (
        (z > near)
        & (u > (-margin_x - cx) * z)
        & (u < (width + margin_x - cx) * z)
        & (v > (-margin_y - cy) * z)
        & (v < (height + margin_y - cy) * z)
    )
    return torch.nonzero(inside).squeeze(-1)

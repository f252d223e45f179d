"""Selects the Gaussians to decode for a viewpoint (HyRF's visibility pre-culling)."""

from __future__ import annotations

import torch
from torch import Tensor

from hyrfpack.ops.dispatch import choose_implementation
from hyrfpack.ops.finite import all_finite
from hyrfpack.ops.viewport import Viewport


def frustum_cull(
    positions: Tensor, viewport: Viewport, near: float, tolerance: float, *, implementation: str = "auto"
) -> Tensor:
    """Return the indices of points in front of the near plane that project into the image or a band around it.

    Args:
        positions: (N, 3) world units.
        viewport: the camera.
        near: smallest depth kept (exclusive), world units.
        tolerance: width of the band as a fraction of half the image's width and height (NDC units).
        implementation: "auto", "reference", or "cpu" or "gpu" (float32 positions; compute in float64).

    Returns:
        (n,) int64, ascending.

    Raises:
        FloatingPointError: a position is NaN or infinite; comparisons alone would drop it silently.
        ValueError: the implementation does not support these positions.
    """
    chosen = choose_implementation("frustum_cull", implementation, ("reference", "cpu", "gpu"), positions)
    if chosen == "gpu":
        from hyrfpack.ops.rasterize import gpu_cull

        return gpu_cull.frustum_cull(positions, viewport, near, tolerance)
    if chosen == "cpu":
        from hyrfpack.ops.rasterize import cpu_cull

        return cpu_cull.frustum_cull(positions, viewport, near, tolerance)
    if not all_finite(positions):
        raise FloatingPointError("positions hold NaN or infinity")
    pose, width, height = viewport.pose.to(positions), viewport.width, viewport.height
    fx, fy, cx, cy = viewport.intrinsics
    x, y, z = (positions @ pose[:3, :3].T + pose[:3, 3]).unbind(-1)
    margin_x, margin_y = tolerance * width / 2, tolerance * height / 2
    u, v = fx * x, fy * y  # The limits are multiplied by z, because a division by z would need a guard against 0.
    inside = (
        (z > near)
        & (u > (-margin_x - cx) * z)
        & (u < (width + margin_x - cx) * z)
        & (v > (-margin_y - cy) * z)
        & (v < (height + margin_y - cy) * z)
    )
    return torch.nonzero(inside).squeeze(-1)


def frustum_cull_into(
    positions: Tensor, viewport: Viewport, near: float, tolerance: float, reserve: int, *, implementation: str = "auto"
) -> tuple[Tensor, Tensor, Tensor]:
    """Return what `frustum_cull` does, without waiting for the GPU, in memory for a given number of indices.

    Args:
        positions: (N, 3) float32 world units, at least one.
        viewport, near, tolerance: as in `frustum_cull`.
        reserve: the largest number of indices returned; others are missing.
        implementation: "auto" or "gpu".

    Returns:
        Distinct indices (min(reserve, N),) int64, of which those of points inside come first, ascending; (1,) int64,
        how many these are; and (2,) int64, which callers must check: not 0 if a position is NaN or infinite, and the
        number of all points inside, which may exceed the reserve. All on the device.

    Raises:
        ValueError: there is no kernel for these positions.
    """
    chosen = choose_implementation("frustum_cull", implementation, ("reference", "gpu"), positions)
    if chosen != "gpu":
        raise ValueError(f"the {chosen} implementation cannot cull into a reserve")
    from hyrfpack.ops.rasterize import gpu_cull

    return gpu_cull.frustum_cull_into(positions, viewport, near, tolerance, reserve)

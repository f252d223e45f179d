"""Contracts unbounded space into the unit cube, the domain of the hash grids."""

from __future__ import annotations

import torch
from torch import Tensor

from hyrfpack.ops.contraction import reference
from hyrfpack.ops.contraction.reference import expand
from hyrfpack.ops.dispatch import choose_implementation
from hyrfpack.ops.transfer import tensor_like

__all__ = ["contract", "expand"]

UNIT_HALF_EXTENT = (1.0, 1.0, 1.0)


def contract(
    points: Tensor,
    half_extent: tuple[float, float, float] = UNIT_HALF_EXTENT,
    *,
    used: Tensor | None = None,
    implementation: str = "auto",
) -> Tensor:
    """Map points into the open unit cube.

    With u = p / half_extent, the ball |u| <= 1 fills the inner half of the cube. Everything outside is squeezed into
    the shell around it (mip-NeRF 360 contraction, shifted and scaled to (0, 1) as HyRF eq. 3 intends):

        c(u) = 0.25 u + 0.5                          |u| <= 1
        c(u) = 0.25 (2 - 1/|u|) u/|u| + 0.5          otherwise

    Args:
        points: (..., 3) p, any finite value.
        half_extent: half-axes of the box around the origin that is scaled to [-1, 1]^3, positive.
        used: the number of points in use, see `hyrfpack.ops.rows`; None if all are.
        implementation: "auto", "reference" or "gpu" (float32). "gpu" has no backward pass and is available only if
            no gradient is needed.

    Returns:
        (..., 3) in [0, 1]. Differentiable everywhere, also at |u| = 1 (C1).

    Raises:
        ValueError: the last axis of `points` is not 3, or the implementation does not support these points.

    Example:
        >>> contract(torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0]]))[:, 0]
        tensor([0.5000, 0.7500, 0.8750])
    """
    if not points.ndim or points.shape[-1] != 3:
        raise ValueError(f"points {tuple(points.shape)} do not end in 3 coordinates")
    needs_grad = torch.is_grad_enabled() and points.requires_grad
    available = ("reference",) if needs_grad else ("reference", "gpu")
    if choose_implementation("contract", implementation, available, points) == "gpu":
        from hyrfpack.ops.contraction import gpu

        return gpu.contract(points, half_extent, used)
    return reference.contract(points if half_extent == UNIT_HALF_EXTENT else points / tensor_like(half_extent, points))

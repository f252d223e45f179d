"""Activates Gaussians: combines their stored logits with the outputs of the geometry field."""

from __future__ import annotations

import torch
from torch import Tensor

from hyrfpack.ops.activate import reference
from hyrfpack.ops.activate.reference import scale_bounds
from hyrfpack.ops.dispatch import choose_implementation

__all__ = ["activate_geometry", "scale_bounds"]


def activate_geometry(
    raw: Tensor,
    positions: Tensor,
    scale_logits: Tensor,
    opacity_logits: Tensor,
    *,
    half_extent: tuple[float, float, float] | None = None,
    rule: str = "sum",
    used: Tensor | None = None,
    implementation: str = "auto",
) -> tuple[Tensor, Tensor, Tensor]:
    """Compute scales, rotations and opacities of Gaussians (HyRF eq. 6, 7) from neural (n) and explicit (e) logits.

        opacity = sigmoid(a_n + a_e)      rotation = r_n + (1, 0, 0, 0)
        scale = S(p) sigmoid(s_n + s_e),  or S(p) sigmoid(s_n) sigmoid(s_e) with rule "product"

    Args:
        raw: (N, 8) outputs of the geometry field, in any layout: a_n, s_n (3), r_n (4).
        positions: (N, 3) p, local units.
        scale_logits, opacity_logits: (N, 1) s_e and a_e.
        half_extent: half-axes of the box in the definition of S(p), see `scale_bounds`; None for S(p) = 1.
        rule: "sum" or "product".
        used: the number of Gaussians in use, see `hyrfpack.ops.rows`; None if all are.
        implementation: "auto", "reference" or "gpu" (float32). "gpu" computes no gradient of positions and is
            available only if none is needed.

    Returns:
        Scales (N, 3) in local units, quaternions (N, 4) wxyz, not normalised, and opacities (N,) in (0, 1).
        Differentiable once.

    Raises:
        ValueError: shapes, dtypes or devices do not match, or the rule is unknown.

    Example:
        >>> raw, positions, logits = torch.zeros(1, 8), torch.zeros(1, 3), torch.zeros(1, 1)
        >>> activate_geometry(raw, positions, logits, logits)
        (tensor([[0.5000, 0.5000, 0.5000]]), tensor([[1., 0., 0., 0.]]), tensor([0.5000]))
    """
    count = len(raw)
    shapes = [tuple(tensor.shape) for tensor in (raw, positions, scale_logits, opacity_logits)]
    if shapes != [(count, 8), (count, 3), (count, 1), (count, 1)] or rule not in ("sum", "product"):
        raise ValueError(f"raw, positions, scale and opacity logits are {shapes}, the rule '{rule}'")
    needs_position_grad = torch.is_grad_enabled() and positions.requires_grad
    available = ("reference",) if needs_position_grad else ("reference", "gpu")
    tensors = raw, positions, scale_logits, opacity_logits
    if choose_implementation("activate_geometry", implementation, available, *tensors) == "gpu":
        from hyrfpack.ops.activate import gpu

        return gpu.activate_geometry(*tensors, half_extent, rule, used)
    return reference.activate_geometry(*tensors, half_extent, rule)

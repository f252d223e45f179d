"""Implements activation in plain torch for any device and dtype. This reference defines the correct result."""

from __future__ import annotations

import torch
from torch import Tensor

from hyrfpack.ops.transfer import tensor_like


def scale_bounds(positions: Tensor, half_extent: tuple[float, float, float] | None) -> Tensor:
    """Return the largest scale S(p), (N, 1), that Gaussians at positions p (N, 3) may have, both in local units.

    S(p) = max(1, |u|) with u = p / half_extent; S(p) = 1 everywhere if half_extent is None.

    Example:
        >>> scale_bounds(torch.tensor([[0.5, 0.0, 0.0], [6.0, 0.0, 0.0]]), (2.0, 2.0, 2.0))
        tensor([[1.],
                [3.]])
    """
    if half_extent is None:
        return positions.new_ones(len(positions), 1)
    return torch.linalg.vector_norm(positions / tensor_like(half_extent, positions), dim=-1, keepdim=True).clamp_min(1)


def activate_geometry(
    raw: Tensor,
    positions: Tensor,
    scale_logits: Tensor,
    opacity_logits: Tensor,
    half_extent: tuple[float, float, float] | None,
    rule: str,
) -> tuple[Tensor, Tensor, Tensor]:
    """Compute `hyrfpack.ops.activate.activate_geometry` with torch operations that autograd differentiates."""
    opacities = torch.sigmoid(raw[:, 0] + opacity_logits[:, 0])
    if rule == "sum":
        shares = torch.sigmoid(raw[:, 1:4] + scale_logits)
    else:
        shares = torch.sigmoid(raw[:, 1:4]) * torch.sigmoid(scale_logits)
    # The identity is created on the device, because a copy from the host would block.
    identity = torch.eye(1, 4, dtype=raw.dtype, device=raw.device)
    return shares * scale_bounds(positions, half_extent), raw[:, 4:] + identity, opacities

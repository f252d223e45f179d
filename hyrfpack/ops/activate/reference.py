"""Activation in plain torch, any device and dtype: the definition of right."""

from __future__ import annotations

import torch
from torch import Tensor

from hyrfpack.ops.transfer import tensor_like


def scale_bounds(positions: Tensor, half_extent: tuple[float, float, float] | None) -> Tensor:
    """S(p), (N, 1): the largest scale that a Gaussian may have at positions (N, 3), both in local units.

    S(p) = max(1, |u|) with u = p / half_extent; 1 everywhere where that is None.

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
    """As `hyrfpack.ops.activate.activate_geometry`."""
    opacities = torch.sigmoid(raw[:, 0] + opacity_logits[:, 0])
    if rule == "sum":
        shares = torch.sigmoid(raw[:, 1:4] + scale_logits)
    else:
        shares = torch.sigmoid(raw[:, 1:4]) * torch.sigmoid(scale_logits)
    no_turn = torch.eye(1, 4, dtype=raw.dtype, device=raw.device)  # made there: a copy would make the host wait
    return shares * scale_bounds(positions, half_extent), raw[:, 4:] + no_turn, opacities

"""Implements the contraction and its inverse in plain torch for any device and dtype.

This reference defines the correct result.
"""

from __future__ import annotations

import torch
from torch import Tensor


def contract(u: Tensor) -> Tensor:
    """Compute `hyrfpack.ops.contraction.contract` for normalised coordinates u (..., 3)."""
    # The vector is divided by its largest component first, because the square of 1e30 would overflow float32.
    largest = u.abs().amax(-1, keepdim=True).clamp_min(1)
    radius = torch.linalg.vector_norm(u / largest, dim=-1, keepdim=True).clamp_min(1 / largest) * largest
    return 0.25 * (2 - 1 / radius) * (u / radius) + 0.5


def expand(c: Tensor) -> Tensor:
    """Map points (..., 3) of the cube back to normalised coordinates u, the inverse of `contract`.

        u = y                             |y| <= 1,     y = 4 (c - 0.5)
        u = y / (|y| (2 - |y|))           otherwise

    No finite u maps to |y| >= 2. Such points are moved just inside, so that |u| stays below 2^20.

    Example:
        >>> expand(torch.tensor([[0.875, 0.5, 0.5]]))
        tensor([[2., 0., 0.]])
    """
    y = 4 * (c - 0.5)
    radius = torch.linalg.vector_norm(y, dim=-1, keepdim=True).clamp_min(1)
    return y / (radius * (2 - radius.clamp_max(2 - 2**-20)))

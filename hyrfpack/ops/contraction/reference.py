"""The contraction and its inverse in plain torch, any device and dtype: the definition of right."""

from __future__ import annotations

import torch
from torch import Tensor


def contract(u: Tensor) -> Tensor:
    """As `hyrfpack.ops.contraction.contract`, of points (..., 3) that are u already."""
    # Divided by the largest component first: the square of 1e30 would overflow float32.
    largest = u.abs().amax(-1, keepdim=True).clamp_min(1)
    radius = torch.linalg.vector_norm(u / largest, dim=-1, keepdim=True).clamp_min(1 / largest) * largest
    return 0.25 * (2 - 1 / radius) * (u / radius) + 0.5


def expand(c: Tensor) -> Tensor:
    """The inverse of `contract`: points (..., 3) of the cube to normalised coordinates u.

        u = y                             |y| <= 1,     y = 4 (c - 0.5)
        u = y / (|y| (2 - |y|))           otherwise

    Points at or past |y| = 2, which no finite u maps to, are taken just inside: |u| stays below 2^20.

    Example:
        >>> expand(torch.tensor([[0.875, 0.5, 0.5]]))
        tensor([[2., 0., 0.]])
    """
    y = 4 * (c - 0.5)
    radius = torch.linalg.vector_norm(y, dim=-1, keepdim=True).clamp_min(1)
    return y / (radius * (2 - radius.clamp_max(2 - 2**-20)))

"""The unit cube that holds all of space: where the hash grids live."""

from __future__ import annotations

import torch
from torch import Tensor


def contract(u: Tensor) -> Tensor:
    """Map normalised coordinates into the open unit cube.

    The ball |u| <= 1 fills the inner half; everything outside is squeezed into the shell around it
    (mip-NeRF 360 contraction, shifted and scaled to (0, 1) as HyRF eq. 3 intends):

        c(u) = 0.25 u + 0.5                          |u| <= 1
        c(u) = 0.25 (2 - 1/|u|) u/|u| + 0.5          otherwise

    Args:
        u: (..., 3) normalised coordinates, any finite value.

    Returns:
        (..., 3) in [0, 1]. Differentiable everywhere, also at |u| = 1 (C1).

    Example:
        >>> contract(torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0]]))[:, 0]
        tensor([0.5000, 0.7500, 0.8750])
    """
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

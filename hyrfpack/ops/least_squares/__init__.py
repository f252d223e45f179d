"""Solves many small least-squares problems at once."""

from __future__ import annotations

import torch
from torch import Tensor

from hyrfpack.ops.dispatch import choose_implementation
from hyrfpack.ops.least_squares import reference

__all__ = ["least_squares"]


@torch.no_grad()
def least_squares(
    index: Tensor,
    basis: Tensor,
    values: Tensor,
    weights: Tensor,
    gram: Tensor,
    right: Tensor,
    *,
    implementation: str = "auto",
) -> Tensor:
    """Solve many small weighted least-squares problems that share a Gram matrix. Not differentiable.

    Problem n consists of the rows r whose index is n, and minimises

        sum_r w_r |b_r h - v_r|^2 + tr(h^T G h) - 2 tr(right_n^T h)

    G and `right` add terms that are known in advance, such as a ridge or rows that all problems share.

    Args:
        index: (R,) int64 in [0, N), the problem to which each row belongs, in any order.
        basis: (R, K) float32 b.
        values: (R, C) float32 v.
        weights: (R,) float32 w, 0 or more.
        gram: (K, K) float64 G, symmetric.
        right: (N, K, C) float32.
        implementation: "auto", "reference" or "cpu".

    Returns:
        (N, K, C) float32 h, solved by normal equations in float64; NaN where these are not positive definite.

    Example:
        >>> basis, values = torch.tensor([[1.0, 0.0], [1.0, 1.0]]), torch.tensor([[3.0], [5.0]])
        >>> nothing = torch.zeros(2, 2).double(), torch.zeros(1, 2, 1)
        >>> least_squares(torch.zeros(2).long(), basis, values, torch.ones(2), *nothing).squeeze().round().tolist()
        [3.0, 2.0]
    """
    rows = basis, values, weights
    if choose_implementation("least_squares", implementation, ("reference", "cpu"), *rows) == "cpu":
        from hyrfpack.ops.least_squares import cpu

        return torch.from_numpy(cpu.least_squares(*(part.contiguous().numpy() for part in (index, *rows, gram, right))))
    return reference.least_squares(index, *rows, gram, right)

"""Solves small least-squares problems in plain torch on any device. This reference defines the correct result."""

from __future__ import annotations

import torch
from torch import Tensor


def least_squares(index: Tensor, basis: Tensor, values: Tensor, weights: Tensor, gram: Tensor, right: Tensor) -> Tensor:
    """Solve the problems of `hyrfpack.ops.least_squares.least_squares`."""
    weighted = (weights[:, None] * basis.double())[:, :, None]
    grams = gram.repeat(len(right), 1, 1).index_add_(0, index, weighted * basis.double()[:, None])
    rights = right.double().index_add_(0, index, weighted * values.double()[:, None])
    factors, failed = torch.linalg.cholesky_ex(grams)
    return torch.where((failed == 0)[:, None, None], torch.cholesky_solve(rights, factors), torch.nan).float()

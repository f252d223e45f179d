"""Small least-squares problems: the compiled kernel and normal equations against numpy, one problem at a time."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from hyrfpack.ops.least_squares import least_squares

TESTED_IMPLEMENTATIONS = ["cpu", "reference"]


def make_problems(count: int = 40, rows: int = 700, terms: int = 9, seed: int = 0) -> tuple[Tensor, ...]:
    """Return rows in random order; some problems have no rows, only the common terms."""
    generator = torch.Generator().manual_seed(seed)
    index = torch.randint(0, max(1, count - 3), (rows,), generator=generator)
    basis, values = torch.randn(rows, terms, generator=generator), torch.randn(rows, 3, generator=generator)
    shared = torch.randn(2 * terms, terms, generator=generator).double()
    right = torch.randn(count, terms, 3, generator=generator)
    return index, basis, values, torch.rand(rows, generator=generator), 0.1 * shared.T @ shared, right


def solve_one_by_one(
    index: Tensor, basis: Tensor, values: Tensor, weights: Tensor, gram: Tensor, right: Tensor
) -> Tensor:
    solved = []
    for problem, known in enumerate(right.double().numpy()):
        b, v, w = (part[index == problem].double().numpy() for part in (basis, values, weights))
        solved.append(np.linalg.solve(gram.numpy() + b.T @ (w[:, None] * b), known + b.T @ (w[:, None] * v)))
    return torch.tensor(np.array(solved)).float()


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
@pytest.mark.parametrize("terms", [1, 4, 16])
def test_solutions_match_numpy(implementation: str, terms: int) -> None:
    given = make_problems(terms=terms)
    torch.testing.assert_close(
        least_squares(*given, implementation=implementation), solve_one_by_one(*given), atol=1e-5, rtol=1e-5
    )


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
def test_the_first_terms_alone_can_be_solved(implementation: str) -> None:
    index, basis, values, weights, gram, right = make_problems(terms=16)
    some = index, basis[:, :4], values, weights, gram[:4, :4], right[:, :4]  # views into larger arrays
    torch.testing.assert_close(
        least_squares(*some, implementation=implementation), solve_one_by_one(*some), atol=1e-5, rtol=1e-5
    )


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
def test_nearly_dependent_rows_agree_with_float64(implementation: str) -> None:
    # Directions a thousandth apart, as of distant cameras: only the ridge separates the terms.
    index, basis, values, weights, _, right = make_problems(terms=4)
    basis, ridge = 1 + 1e-3 * basis, 1e-5 * torch.eye(4, dtype=torch.float64)
    given = index, basis, values, weights, ridge, 1e-5 * right
    torch.testing.assert_close(
        least_squares(*given, implementation=implementation), solve_one_by_one(*given), atol=1e-3, rtol=1e-3
    )


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
def test_a_problem_without_a_solution_is_nan_and_affects_no_other(implementation: str) -> None:
    index, basis, values, weights, gram, right = make_problems()
    found = least_squares(index, basis, values, weights, torch.zeros_like(gram), right, implementation=implementation)
    assert found[-1].isnan().all() and found[:5].isfinite().all()
    basis[0] = torch.nan
    broken = least_squares(index, basis, values, weights, gram, right, implementation=implementation)
    others = torch.arange(len(right)) != index[0]
    assert not broken[index[0]].isfinite().any() and broken[others].isfinite().all()


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
def test_empty_problems_and_empty_rows_are_supported(implementation: str) -> None:
    assert least_squares(*make_problems(count=0, rows=0), implementation=implementation).shape == (0, 9, 3)
    alone = make_problems(rows=0)
    torch.testing.assert_close(
        least_squares(*alone, implementation=implementation), solve_one_by_one(*alone), atol=1e-5, rtol=1e-5
    )

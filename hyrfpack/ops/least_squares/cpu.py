"""Solves small least-squares problems on the CPU in compiled code, one at a time, so that each stays in the L1 cache.

For such small matrices, batched LAPACK calls are mostly overhead, and batched products write all matrices to memory.
"""

from __future__ import annotations

import math

import numpy as np

from hyrfpack.parallel.compiled import compiled

_kernel = compiled(fastmath={"contract", "nsz"}, error_model="numpy")


@_kernel
def least_squares(index, basis, values, weights, gram, right):
    """Solve the problems of `hyrfpack.ops.least_squares.least_squares`, given as arrays."""
    problems, terms, columns = right.shape
    solved = np.empty((problems, terms, columns), np.float32)
    order, starts = _group_by_problem(index, problems)
    factor, unknowns, row = np.empty((terms, terms)), np.empty((terms, columns)), np.empty(terms)
    for problem in range(problems):
        for i in range(terms):
            for j in range(i + 1):
                factor[i, j] = gram[i, j]
            for c in range(columns):
                unknowns[i, c] = right[problem, i, c]
        for position in range(starts[problem], starts[problem + 1]):
            at = order[position]
            weight = np.float64(weights[at])
            for i in range(terms):
                row[i] = basis[at, i]
            for i in range(terms):
                weighted = weight * row[i]
                for j in range(i + 1):
                    factor[i, j] += weighted * row[j]
                for c in range(columns):
                    unknowns[i, c] += weighted * np.float64(values[at, c])
        _factorise(factor)
        _substitute(factor, unknowns)
        for i in range(terms):
            for c in range(columns):
                solved[problem, i, c] = unknowns[i, c]
    return solved


@_kernel
def _group_by_problem(index, problems):
    """Group rows by problem.

    Returns:
        (R,) the row indices sorted by problem, and (problems + 1,) the position of each problem's first row in them.
    """
    starts = np.zeros(problems + 1, np.int64)
    for at in index:
        starts[at + 1] += 1
    for problem in range(problems):
        starts[problem + 1] += starts[problem]
    order, next_positions = np.empty(len(index), np.int64), starts[:-1].copy()
    for row in range(len(index)):
        order[next_positions[index[row]]] = row
        next_positions[index[row]] += 1
    return order, starts


@_kernel
def _factorise(matrix):
    """Replace the lower triangle of a symmetric matrix by its Cholesky factor."""
    for i in range(len(matrix)):
        for j in range(i + 1):
            rest = matrix[i, j]
            for k in range(j):
                rest -= matrix[i, k] * matrix[j, k]
            # If the matrix is not positive definite, the root is NaN, and so is everything computed from it.
            matrix[i, j] = math.sqrt(rest if rest > 0 else math.nan) if i == j else rest / matrix[j, j]


@_kernel
def _substitute(factor, unknowns):
    """Solve factor factor^T x = unknowns, in place."""
    terms, columns = unknowns.shape
    for i in range(terms):
        for c in range(columns):
            for k in range(i):
                unknowns[i, c] -= factor[i, k] * unknowns[k, c]
            unknowns[i, c] /= factor[i, i]
    for i in range(terms - 1, -1, -1):
        for c in range(columns):
            for k in range(i + 1, terms):
                unknowns[i, c] -= factor[k, i] * unknowns[k, c]
            unknowns[i, c] /= factor[i, i]

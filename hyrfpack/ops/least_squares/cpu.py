"""Small least-squares problems on the CPU: compiled, one after the other, so that each stays in the first cache.

Batched LAPACK spends most of its time between such small matrices, and batched products write them all to memory.
"""

from __future__ import annotations

import math

import numpy as np

from hyrfpack.parallel.compiled import compiled

_kernel = compiled(fastmath={"contract", "nsz"}, error_model="numpy")


@_kernel
def least_squares(index, basis, values, weights, gram, right):
    """As `hyrfpack.ops.least_squares.least_squares`, with arrays."""
    problems, terms, columns = right.shape
    solved = np.empty((problems, terms, columns), np.float32)
    order, starts = _by_problem(index, problems)
    factor, unknowns, row = np.empty((terms, terms)), np.empty((terms, columns)), np.empty(terms)
    for problem in range(problems):
        for i in range(terms):
            for j in range(i + 1):
                factor[i, j] = gram[i, j]
            for c in range(columns):
                unknowns[i, c] = right[problem, i, c]
        for place in range(starts[problem], starts[problem + 1]):
            at = order[place]
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
def _by_problem(index, problems):
    """The rows (R,) in the order of their problems, and where each problem's begin (problems + 1,)."""
    starts = np.zeros(problems + 1, np.int64)
    for at in index:
        starts[at + 1] += 1
    for problem in range(problems):
        starts[problem + 1] += starts[problem]
    order, places = np.empty(len(index), np.int64), starts[:-1].copy()
    for row in range(len(index)):
        order[places[index[row]]] = row
        places[index[row]] += 1
    return order, starts


@_kernel
def _factorise(matrix):
    """Cholesky: the lower triangle of a matrix becomes that of its factor."""
    for i in range(len(matrix)):
        for j in range(i + 1):
            rest = matrix[i, j]
            for k in range(j):
                rest -= matrix[i, k] * matrix[j, k]
            # The root of what is not positive is NaN, and with it all that follows.
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

"""Lifting: each number of a list is predicted from neighbours that are decoded before it.

The list is coded in levels: first number 0, then the numbers at odd multiples of the largest power of two, and so on
down to the odd indices. A number at an odd multiple of d is predicted from the neighbours d before and d after it. The
prediction is weight / 16 times their mean, or times the number before if none follows. The rounded difference is
stored, in steps.

All arithmetic is in integers (fixed point, `steps.FIXED_POINT_ONE`), so that every decoder gets the same bits. A whole
level is one array operation, because no number depends on another of its level.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

MAX_WEIGHT_SIXTEENTHS = 16
_NUMBERS_PER_BLOCK = 1 << 14  # Temporary arrays of this size stay in the caches.


def iter_levels(count: int) -> Iterator[tuple[np.ndarray, int]]:
    """Yield the indices (n,) of each level after the first and the distance d to their neighbours, coarse levels first.

    Long levels come in several blocks, so that temporary arrays stay in the caches.
    """
    distance = 1 << max(count - 1, 0).bit_length()
    while distance > 1:
        distance //= 2
        for first in range(distance, count, 2 * distance * _NUMBERS_PER_BLOCK):
            yield np.arange(first, min(first + 2 * distance * _NUMBERS_PER_BLOCK, count), 2 * distance), distance


def predict(values: np.ndarray, indices: np.ndarray, distance: int, weight: int) -> np.ndarray:
    """Predict the numbers at `indices` from neighbours that have been decoded.

    Args:
        values: (N,) int64 decoded numbers.
        indices: (n,) from `iter_levels`, 2 d apart.
        distance: d.
        weight: weight of the prediction in 16ths, 0 to MAX_WEIGHT_SIXTEENTHS.

    Returns:
        (n,) int64.
    """
    if weight == 0:
        return np.zeros(len(indices), np.int64)
    neighbours = values[indices[0] - distance : indices[-1] + distance + 1 : 2 * distance]
    prediction = neighbours[: len(indices)].copy()
    later_neighbours = neighbours[1:]
    prediction[: len(later_neighbours)] += later_neighbours
    prediction[len(later_neighbours) :] *= 2  # the last number has no neighbour after it
    prediction *= weight
    prediction >>= 5
    return prediction


def lift(
    count: int, weight: int, steps: np.ndarray, choose: Callable[[np.ndarray, np.ndarray], np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Quantise a list of numbers: the encoder for `inverse_lift`.

    Args:
        count: N.
        weight: weight of the prediction in 16ths, 0 to MAX_WEIGHT_SIXTEENTHS.
        steps: (N,) int64 quantisation steps.
        choose: function of indices (n,) and predictions (n,) that returns the differences (n,) int64, in steps.

    Returns:
        The differences (N,) int64, and the numbers as they will be decoded (N,) int64.
    """
    residuals, values = np.zeros((2, count), np.int64)
    first = np.arange(min(count, 1))
    for indices, distance in [(first, 0), *iter_levels(count)]:
        prediction = predict(values, indices, distance, weight) if distance else np.zeros(len(indices), np.int64)
        residuals[indices] = choose(indices, prediction)
        values[indices] = prediction + residuals[indices] * steps[indices]
    return residuals, values


def inverse_lift(residuals: np.ndarray, weight: int, steps: np.ndarray) -> np.ndarray:
    """Return the numbers (N,) int64 from differences (N,), in units of steps (N,) int64."""
    values = np.multiply(residuals, steps, dtype=np.int64)
    if weight:
        for indices, distance in iter_levels(len(values)):
            values[indices[0] : indices[-1] + 1 : 2 * distance] += predict(values, indices, distance, weight)
    return values

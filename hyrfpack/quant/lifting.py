"""Numbers along a list, each predicted from neighbours that are decoded before it.

The list is halved again and again: first comes number 0, then those at odd multiples of the largest power of two, and
so on down to the odd places. A number at an odd multiple of d is predicted by the mean of its neighbours d before and
d after it (the last by the one before), times weight / 16. What is stored is the difference in steps, rounded.

All in integers (fixed point, `steps.ONE`), so that every decoder gets the same bits; a whole level is one array
operation, as no number of it depends on another.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

_PART = 1 << 14


def levels(count: int) -> Iterator[tuple[np.ndarray, int]]:
    """The places (n,) of each level after the first, and the distance d to their neighbours; coarse levels first.

    Long levels come in parts, which temporaries in the caches are enough for.
    """
    distance = 1 << max(count - 1, 0).bit_length()
    while distance > 1:
        distance //= 2
        for first in range(distance, count, 2 * distance * _PART):
            yield np.arange(first, min(first + 2 * distance * _PART, count), 2 * distance), distance


def predict(values: np.ndarray, places: np.ndarray, distance: int, weight: int) -> np.ndarray:
    """Predictions (n,) int64 for the numbers at `places`, from decoded `values` (N,) int64; weight 0 to 16.

    Args:
        places: as from `levels`: 2 d apart.
    """
    if weight == 0:
        return np.zeros(len(places), np.int64)
    neighbours = values[places[0] - distance : places[-1] + distance + 1 : 2 * distance]
    prediction = neighbours[: len(places)].copy()
    after = neighbours[1:]
    prediction[: len(after)] += after
    prediction[len(after) :] *= 2  # the last has none after it
    prediction *= weight
    prediction >>= 5
    return prediction


def lift(
    count: int, weight: int, steps: np.ndarray, choose: Callable[[np.ndarray, np.ndarray], np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Quantise a list. The encoder's side of `unlift`.

    Args:
        count: N.
        weight: of the prediction, 0 to 16.
        steps: (N,) int64.
        choose: called with places (n,) and predictions (n,); returns the differences (n,) int64, in steps.

    Returns:
        The differences (N,) int64, and the numbers as they will be decoded (N,) int64.
    """
    residuals, values = np.zeros((2, count), np.int64)
    first = np.arange(min(count, 1))
    for places, distance in [(first, 0), *levels(count)]:
        prediction = predict(values, places, distance, weight) if distance else np.zeros(len(places), np.int64)
        residuals[places] = choose(places, prediction)
        values[places] = prediction + residuals[places] * steps[places]
    return residuals, values


def unlift(residuals: np.ndarray, weight: int, steps: np.ndarray) -> np.ndarray:
    """The numbers (N,) int64 from differences (N,) in steps (N,) int64."""
    values = np.multiply(residuals, steps, dtype=np.int64)
    if weight:
        for places, distance in levels(len(values)):
            values[places[0] : places[-1] + 1 : 2 * distance] += predict(values, places, distance, weight)
    return values

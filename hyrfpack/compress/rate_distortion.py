"""Rate-distortion quantisation: each number gets the multiple of its step that costs least, bits counted as error.

At the optimum every number adds the same error D to the pictures, and a bit less anywhere costs 2 ln 2 D (from
D ~ 4^-bits). So a step is sqrt(12 D / s) for sensitivity s, and a choice is worth its error + 2 ln 2 D * its bits.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from hyrfpack.quant.steps import step_code

ERROR_PER_BIT = 2 * np.log(2)  # in D
_WIDEST = 4096  # symbols told apart in a table of costs; the tails are rare, and share one


def best_steps(sensitivity: np.ndarray, distortion: float) -> np.ndarray:
    """Step codes, uint8, for mean sensitivities (n,) above 0: uniform errors then add `distortion` (D) each."""
    return step_code(np.sqrt(12 * distortion / np.maximum(sensitivity, 1e-300)))


def code_bits(symbols: np.ndarray, classes: np.ndarray, count: int, reach: int) -> tuple[np.ndarray, int]:
    """What a symbol costs in its class, estimated from (n,) symbols like those to be coded.

    Returns:
        (count, S) bits of the symbols from `least` to `least` + S - 1, room for `reach` on both sides; and `least`.
    """
    least = int(symbols.min(initial=0)) - reach
    width = int(symbols.max(initial=0)) + reach + 1 - least
    if width > _WIDEST:
        least, width = -_WIDEST // 2, _WIDEST
    index = np.clip(symbols - least, 0, width - 1)
    index += classes.astype(np.int64) * width
    histogram = np.bincount(index, minlength=count * width).reshape(count, width) + 0.25
    return -np.log2(histogram / histogram.sum(axis=1, keepdims=True)), least


def bits_of(symbols: np.ndarray, classes: np.ndarray, bits: tuple[np.ndarray, int]) -> np.ndarray:
    """What each of (n,) symbols costs by `code_bits`."""
    table, least = bits
    return table[classes, np.clip(symbols - least, 0, table.shape[1] - 1)]


def cheapest(
    nearest: np.ndarray,
    error: Callable[[np.ndarray], np.ndarray],
    classes: np.ndarray,
    bits: tuple[np.ndarray, int],
    distortion: float,
    reach: int,
) -> np.ndarray:
    """The best of the symbols within `reach` of the nearest (n,) int64.

    Args:
        error: of candidates (n,): what each would add to the pictures' mean squared error.
        classes: (n,) of each symbol.
        bits: from `code_bits`.
        distortion: D.
    """
    table, least = bits
    width = table.shape[1]
    rates = (ERROR_PER_BIT * distortion * table).ravel()
    rows = classes.astype(np.int64) * width
    best, least_cost = nearest.copy(), np.full(len(nearest), np.inf)
    for shift in sorted(range(-reach, reach + 1), key=abs):
        candidate = nearest + shift
        places = candidate - least
        np.clip(places, 0, width - 1, out=places)
        places += rows
        cost = error(candidate) + rates.take(places)
        better = cost < least_cost
        np.copyto(best, candidate, where=better)
        np.copyto(least_cost, cost, where=better)
    return best

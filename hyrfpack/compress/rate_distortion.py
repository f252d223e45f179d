"""Rate-distortion quantisation: choose for each number the symbol with the lowest cost, error + lambda * bits.

At the optimum every number adds the same error D to the pictures. Saving one bit then adds the error 2 ln 2 D, because
D ~ 4^-bits, so lambda = 2 ln 2 D. The step that adds D on average is sqrt(12 D / s) for a number of sensitivity s.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from hyrfpack.quant.steps import encode_step

LAMBDA_PER_DISTORTION = 2 * np.log(2)
# A table of code lengths has at most this many symbols. Those beyond its ends are rare and share the last entry.
_MAX_TABLE_SYMBOLS = 4096


def choose_step_codes(sensitivity: np.ndarray, distortion: float) -> np.ndarray:
    """Choose step codes (n,) uint8 for mean sensitivities (n,) > 0, so that rounding each number adds the error D."""
    return encode_step(np.sqrt(12 * distortion / np.maximum(sensitivity, 1e-300)))


def estimate_code_bits(symbols: np.ndarray, classes: np.ndarray, count: int, reach: int) -> tuple[np.ndarray, int]:
    """Estimate the code length of each symbol in each class from the histogram of similar symbols (n,).

    Args:
        symbols: (n,) int64, distributed like those to be coded.
        classes: (n,) class of each symbol.
        count: number of classes.
        reach: the table has room for this many more symbols on both sides.

    Returns:
        (count, S) bits of the symbols from `lowest_symbol` to `lowest_symbol` + S - 1; and `lowest_symbol`.
    """
    lowest_symbol = int(symbols.min(initial=0)) - reach
    width = int(symbols.max(initial=0)) + reach + 1 - lowest_symbol
    if width > _MAX_TABLE_SYMBOLS:
        lowest_symbol, width = -_MAX_TABLE_SYMBOLS // 2, _MAX_TABLE_SYMBOLS
    index = np.clip(symbols - lowest_symbol, 0, width - 1)
    index += classes.astype(np.int64) * width
    histogram = np.bincount(index, minlength=count * width).reshape(count, width) + 0.25
    return -np.log2(histogram / histogram.sum(axis=1, keepdims=True)), lowest_symbol


def look_up_bits(symbols: np.ndarray, classes: np.ndarray, bits: tuple[np.ndarray, int]) -> np.ndarray:
    """Look up the bits of each of (n,) symbols in the table of `estimate_code_bits`."""
    table, lowest_symbol = bits
    return table[classes, np.clip(symbols - lowest_symbol, 0, table.shape[1] - 1)]


def choose_symbols(
    nearest: np.ndarray,
    error: Callable[[np.ndarray], np.ndarray],
    classes: np.ndarray,
    bits: tuple[np.ndarray, int],
    distortion: float,
    reach: int,
) -> np.ndarray:
    """Choose for each number the symbol with the lowest rate-distortion cost within `reach` of the nearest one.

    Args:
        nearest: (n,) int64 symbols closest to the numbers.
        error: maps candidate symbols (n,) to the mean squared error (n,) that each would add to the pictures.
        classes: (n,) class of each symbol.
        bits: table from `estimate_code_bits`.
        distortion: D, the error that each number may add.
        reach: distance of the furthest candidate from the nearest symbol.

    Returns:
        (n,) int64 symbols.
    """
    table, lowest_symbol = bits
    width = table.shape[1]
    rates = (LAMBDA_PER_DISTORTION * distortion * table).ravel()
    rows = classes.astype(np.int64) * width
    best, least_cost = nearest.copy(), np.full(len(nearest), np.inf)
    for shift in sorted(range(-reach, reach + 1), key=abs):
        candidate = nearest + shift
        places = candidate - lowest_symbol
        np.clip(places, 0, width - 1, out=places)
        places += rows
        cost = error(candidate) + rates.take(places)
        better = cost < least_cost
        np.copyto(best, candidate, where=better)
        np.copyto(least_cost, cost, where=better)
    return best

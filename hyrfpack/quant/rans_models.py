"""Frequencies for the rANS coder: the probability of each token, in 4096ths.

A *model* is one row of frequencies; a stream has one model per context. Every function takes and returns the rows of
all models. Further axes in front are points in a stream, between which adaptive models change. The decoder's symbols
depend on these numbers, so they are computed in integers only.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

SCALE_BITS = 12
FREQUENCY_TOTAL = 1 << SCALE_BITS
"""Sum of the frequencies of a model."""

MAX_ALPHABET_SIZE = 126
"""Largest number of tokens in an alphabet. `normalise` works for up to 127."""

MAX_LEVEL = 4 * SCALE_BITS + 1
"""Highest level of a static model."""

_PRIOR_SYMBOLS = 16  # In each context, the frequencies over all contexts weigh as much as this many symbols.
_WEIGHT_FRACTION_BITS = 16

_LEVEL_RANKS = np.arange(MAX_LEVEL, dtype=np.int64)
LEVEL_WEIGHTS = np.append(0, (4 + _LEVEL_RANKS % 4) << (_LEVEL_RANKS // 4))
"""(MAX_LEVEL + 1,) weight of each level: 0, 4, 5, 6, 7, 8, 10, 12, 14, 16, 20, ... 16384; four levels per octave."""

_POSITIVE_FREQUENCIES = np.maximum(np.arange(FREQUENCY_TOTAL + 1), 0.5)
COST_BY_FREQUENCY = np.rint(65536 * (SCALE_BITS - np.log2(_POSITIVE_FREQUENCIES))).astype(np.int64)
"""(4097,) code length of each frequency, in 2^-16 bits. Only encoders use it, to choose between variants, because it is
computed in floating point."""


def normalise(weights: np.ndarray) -> np.ndarray:
    """Scale weights to frequencies that add up to 4096.

        f_i = max(1, floor(4096 w_i / sum w)) where w_i > 0, else 0;   the first largest weight gets the remainder

    That weight keeps a frequency of at least 1: if b frequencies were raised to 1, the remainder is at least -(b - 1).
    The largest frequency is at least floor((4096 - b) / (A - b)), and (4096 - b) >= b (A - b) for every b if A <= 127.

    Args:
        weights: (..., K, A) int64, 0 to 2^50, A at most `MAX_ALPHABET_SIZE`; no row is all zero.

    Returns:
        (..., K, A) int64 frequencies; each row adds up to 4096.
    """
    rows = weights.reshape(-1, weights.shape[-1])
    frequencies = np.maximum((rows << SCALE_BITS) // rows.sum(axis=1, keepdims=True), rows > 0)
    largest = rows.argmax(axis=1)
    frequencies[np.arange(len(rows)), largest] += FREQUENCY_TOTAL - frequencies.sum(axis=1)
    return frequencies.reshape(weights.shape)


def adaptive_frequencies(counts: np.ndarray) -> np.ndarray:
    """Return the frequencies of adaptive models from the counts of the symbols so far.

    With n_c,i the counts of token i in context c and g_i = 1 + 2 (sum over c of n_c,i), the weights are

        w_c,i = 2^16 n_c,i + floor(16 2^16 g_i / sum g) + 1

    that is, the counts in the context plus the distribution over all contexts with the weight of 16 symbols.

    Args:
        counts: (..., K, A) int64; their sum is below 2^34.

    Returns:
        (..., K, A) int64 frequencies as from `normalise`; none is 0.
    """
    pooled = 2 * counts.sum(axis=-2, keepdims=True) + 1
    prior = (pooled * (_PRIOR_SYMBOLS << _WEIGHT_FRACTION_BITS)) // pooled.sum(axis=-1, keepdims=True) + 1
    return normalise((counts << _WEIGHT_FRACTION_BITS) + prior)


def iter_update_ranges(steps: int) -> Iterator[tuple[int, int]]:
    """Yield the ranges (start, stop) of steps between two updates of adaptive models; together they cover 0 to `steps`.

    The updates are before the steps 1, 2, ..., 8, 10, 12, ...: the update after t is at t + 1 + floor(t / 8).
    """
    start, stop = 0, 1
    while start < steps:
        yield start, min(stop, steps)
        start, stop = stop, stop + 1 + stop // 8


def static_levels(counts: np.ndarray) -> np.ndarray:
    """Return the levels (K, A) int64 of static models for counts (K, A); 0 where a token does not occur.

    A context without symbols gets the levels of the context before it, or else of the first context with symbols.
    """
    totals = counts.sum(axis=1)
    shares = 4 * FREQUENCY_TOTAL * counts // np.maximum(totals, 1)[:, None]
    middles = (LEVEL_WEIGHTS[1:-1] + LEVEL_WEIGHTS[2:] + 1) // 2
    levels = np.where(counts > 0, 1 + np.searchsorted(middles, shares, side="right"), 0)
    used = np.maximum.accumulate(np.where(totals > 0, np.arange(len(totals)), -1))
    return levels[np.where(used < 0, np.argmax(totals > 0), used)]


def static_frequencies(levels: np.ndarray) -> np.ndarray:
    """Return the frequencies (K, A) int64 of levels: `normalise` applied to their `LEVEL_WEIGHTS`."""
    return normalise(LEVEL_WEIGHTS[levels])

"""Frequencies for the rANS coder: how likely each token is, in 4096ths, in integers only.

A *model* is one row of frequencies; a stream has one for each context. Every function takes and returns all rows
at once. What a decoder computes here decides symbols, so there is no floating point.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

SCALE_BITS = 12
SCALE = 1 << SCALE_BITS
"""What the frequencies of a model add up to."""

MAX_TOKENS = 126
"""Most tokens of an alphabet. Up to 127, `normalise` always finds frequencies."""

MAX_LEVEL = 4 * SCALE_BITS + 1
"""Highest level of a static model."""

_PRIOR = 16  # how many observed symbols the frequencies over all contexts count as, in each context
_FRACTION_BITS = 16

_rank = np.arange(MAX_LEVEL, dtype=np.int64)
LEVEL_WEIGHTS = np.append(0, (4 + _rank % 4) << (_rank // 4))
"""(MAX_LEVEL + 1,) weight of each level: 0, 4, 5, 6, 7, 8, 10, 12, 14, 16, 20, ... 16384; four to the octave."""

# Code length of each frequency in 2^-16 bits. Only encoders look here, to choose.
COSTS = np.rint(65536 * (SCALE_BITS - np.log2(np.maximum(np.arange(SCALE + 1), 0.5)))).astype(np.int64)


def normalise(weights: np.ndarray) -> np.ndarray:
    """Scale weights to frequencies.

        f_i = max(1, floor(4096 w_i / sum w)) where w_i > 0, else 0;   the first largest weight takes what is left

    It keeps at least 1: if b frequencies were raised to 1, at most b - 1 are owed, the largest is at least
    floor((4096 - b) / (A - b)), and (4096 - b) >= b (A - b) for every b as long as A <= 127.

    Args:
        weights: (K, A) int64, 0 to 2^50, A at most `MAX_TOKENS`; no row is all zero.

    Returns:
        (K, A) int64 frequencies; each row adds up to 4096.
    """
    frequencies = np.maximum((weights << SCALE_BITS) // weights.sum(axis=1, keepdims=True), weights > 0)
    largest = weights.argmax(axis=1)
    frequencies[np.arange(len(weights)), largest] += SCALE - frequencies.sum(axis=1)
    return frequencies


def adaptive_frequencies(counts: np.ndarray) -> np.ndarray:
    """Frequencies after some symbols have been seen.

    With n_c,i the counts of token i in context c and g_i = 1 + 2 (sum over c of n_c,i), the weights are

        w_c,i = 2^16 n_c,i + floor(16 2^16 g_i / sum g) + 1

    that is, what was seen in the context and, as if it were 16 more symbols, what was seen in all of them.

    Args:
        counts: (K, A) int64, together below 2^34.

    Returns:
        (K, A) int64 as from `normalise`; none is 0.
    """
    pooled = 2 * counts.sum(axis=0) + 1
    prior = (pooled * (_PRIOR << _FRACTION_BITS)) // pooled.sum() + 1
    return normalise((counts << _FRACTION_BITS) + prior)


def update_steps(steps: int) -> Iterator[tuple[int, int]]:
    """Ranges (start, stop) of steps between two updates of adaptive models, the whole being 0 to `steps`.

    The updates are before the steps 1, 2, ..., 8, 10, 12, ...: t is followed by t + 1 + floor(t / 8).
    """
    start, stop = 0, 1
    while start < steps:
        yield start, min(stop, steps)
        start, stop = stop, stop + 1 + stop // 8


def levels_of(counts: np.ndarray) -> np.ndarray:
    """Levels (K, A) int64 that describe a static model for these counts; 0 where a token does not occur.

    A context without any symbol gets the levels of the one before it, or else of the first that has some.
    """
    totals = counts.sum(axis=1)
    shares = 4 * SCALE * counts // np.maximum(totals, 1)[:, None]
    middles = (LEVEL_WEIGHTS[1:-1] + LEVEL_WEIGHTS[2:] + 1) // 2
    levels = np.where(counts > 0, 1 + np.searchsorted(middles, shares, side="right"), 0)
    used = np.maximum.accumulate(np.where(totals > 0, np.arange(len(totals)), -1))
    return levels[np.where(used < 0, np.argmax(totals > 0), used)]


def static_frequencies(levels: np.ndarray) -> np.ndarray:
    """(K, A) int64 frequencies of these levels: those of `normalise` for the weights `LEVEL_WEIGHTS`."""
    return normalise(LEVEL_WEIGHTS[levels])

"""Quantisation steps, coded in one byte each and exact as integers."""

from __future__ import annotations

import numpy as np

FIXED_POINT_ONE = 1 << 24  # The unit of fixed-point numbers is 2^-24.
MAX_ABS_SYMBOL = 1 << 24  # Numbers and residuals of files are at most this many steps in magnitude.
ALL_ZERO_CODE = 0  # A group with this code has only zeros, so no symbols are stored.


def decode_step(code: int | np.ndarray) -> np.ndarray:
    """Return the step, int64 in units of 2^-24, of a code e from 1 to 255: (8 + e mod 8) 2^(e div 8).

    Each step is 1/15 to 1/8 larger than the previous one. Steps range from 5e-7 to 1920.

    Example:
        >>> float(decode_step(encode_step(0.25)) / FIXED_POINT_ONE)
        0.25
    """
    code = np.asarray(code, np.int64)
    return (8 + (code & 7)) << (code >> 3)


def encode_step(step: float | np.ndarray) -> np.ndarray:
    """Return the code, uint8 from 1 to 255, whose step is nearest to `step` > 0 by ratio.

    It is the inverse of `decode_step`.
    """
    edges = np.sqrt(_STEP_BY_CODE[1:-1] * _STEP_BY_CODE[2:])
    return (1 + np.searchsorted(edges, np.asarray(step, np.float64) * FIXED_POINT_ONE)).astype(np.uint8)


_STEP_BY_CODE = decode_step(np.arange(256)).astype(np.float64)

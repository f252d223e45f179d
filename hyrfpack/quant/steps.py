"""Quantisation steps in one byte each, exact as integers."""

from __future__ import annotations

import numpy as np

ONE = 1 << 24  # values in fixed point: units of 2^-24
NOT_CODED = 0  # this byte stands for "all zero, nothing stored"


def step_of(code: int | np.ndarray) -> np.ndarray:
    """The step, int64 in units of 2^-24, of a code from 1 to 255: (8 + e mod 8) 2^(e div 8).

    Neighbouring steps differ by 1/15 to 1/8; they reach from 5e-7 to 1920.

    Example:
        >>> float(step_of(step_code(0.25)) / ONE)
        0.25
    """
    code = np.asarray(code, np.int64)
    return (8 + (code & 7)) << (code >> 3)


def step_code(step: float | np.ndarray) -> np.ndarray:
    """The code, uint8 from 1 to 255, whose step is nearest to `step` (positive; in ratio). The inverse of `step_of`."""
    edges = np.sqrt(_STEPS[1:-1] * _STEPS[2:])
    return (1 + np.searchsorted(edges, np.asarray(step, np.float64) * ONE)).astype(np.uint8)


_STEPS = step_of(np.arange(256)).astype(np.float64)

"""Morton (Z-order) codes, which interleave the bits of three coordinates.

Points that are neighbours in the order of their codes are close in space.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np
import torch

MAX_BITS_PER_AXIS = 18  # A code then has 54 bits, so that the integer coder can code gaps between codes.

# (shift, mask) of each step that moves groups of bits apart, from 21 consecutive bits to every third bit.
_SPREAD_STEPS = (
    (32, 0x1F00000000FFFF),
    (16, 0x1F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)
# (shift, mask) of each step of the inverse, from every third bit to 21 consecutive bits.
_GATHER_STEPS = (
    (2, 0x10C30C30C30C30C3),
    (4, 0x100F00F00F00F00F),
    (8, 0x1F0000FF0000FF),
    (16, 0x1F00000000FFFF),
    (32, 0x1FFFFF),
)
_POINTS_PER_BLOCK = 1 << 14  # Temporary arrays of this size stay in the caches.

Integers = TypeVar("Integers", np.ndarray, torch.Tensor)


def spread_bits(numbers: Integers) -> Integers:
    """Move bit i of int64 numbers from 0 to 2^21 - 1 to bit 3 i, in place, and return them.

    Example:
        >>> spread_bits(torch.tensor([3, 4])).tolist()
        [9, 64]
    """
    for shift, mask in _SPREAD_STEPS:
        numbers |= numbers << shift
        numbers &= mask
    return numbers


def morton_codes(cells: np.ndarray) -> np.ndarray:
    """Return the codes (N,) int64 of cells (N, 3), each coordinate 0 to 2^21 - 1.

    Bit 3 i + a of a code is bit i of coordinate a.

    Example:
        >>> morton_codes(np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1]])).tolist()
        [1, 2, 4]
    """
    codes = np.zeros(len(cells), np.int64)
    for first in range(0, len(cells), _POINTS_PER_BLOCK):
        part = slice(first, first + _POINTS_PER_BLOCK)
        for axis in range(3):
            bits = spread_bits(cells[part, axis].astype(np.int64))
            bits <<= axis
            codes[part] |= bits
    return codes


def morton_cells(codes: np.ndarray) -> np.ndarray:
    """Return the cells (N, 3) int32 of codes (N,) int64 >= 0: the inverse of `morton_codes`."""
    cells = np.empty((len(codes), 3), np.int32)
    for first in range(0, len(codes), _POINTS_PER_BLOCK):
        part = slice(first, first + _POINTS_PER_BLOCK)
        for axis in range(3):
            bits = codes[part] >> axis
            bits &= _SPREAD_STEPS[-1][1]
            for shift, mask in _GATHER_STEPS:
                bits |= bits >> shift
                bits &= mask
            cells[part, axis] = bits
    return cells

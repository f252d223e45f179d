"""Morton (Z-order) codes: the bits of three coordinates interleaved; neighbours in the list are near in space."""

from __future__ import annotations

import numpy as np

MAX_BITS = 18  # of a coordinate: a code has 54 bits, and gaps between codes fit the integer coder

# Each step doubles the distance between groups of bits: 0x1FFFFF -> every third bit.
_SPREAD = (
    (32, 0x1F00000000FFFF),
    (16, 0x1F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)


def morton_codes(cells: np.ndarray) -> np.ndarray:
    """Cells (N, 3), each coordinate 0 to 2^21 - 1, to codes (N,) int64: bit 3 i + a is bit i of coordinate a."""
    codes = np.zeros(len(cells), np.int64)
    for axis in range(3):
        bits = cells[:, axis].astype(np.int64)
        for shift, mask in _SPREAD:
            bits = (bits | bits << shift) & mask
        codes |= bits << axis
    return codes


def morton_cells(codes: np.ndarray) -> np.ndarray:
    """The inverse of `morton_codes`: codes (N,) below 2^63 to cells (N, 3) int64."""
    cells = np.empty((len(codes), 3), np.int64)
    for axis in range(3):
        bits = codes.astype(np.int64) >> axis & _SPREAD[-1][1]
        for (shift, _), mask in zip(_SPREAD[::-1], [mask for _, mask in _SPREAD[-2::-1]] + [0x1FFFFF], strict=True):
            bits = (bits | bits >> shift) & mask
        cells[:, axis] = bits
    return cells

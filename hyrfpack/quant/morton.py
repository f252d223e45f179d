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
# And back.
_GATHER = (
    (2, 0x10C30C30C30C30C3),
    (4, 0x100F00F00F00F00F),
    (8, 0x1F0000FF0000FF),
    (16, 0x1F00000000FFFF),
    (32, 0x1FFFFF),
)
_BLOCK = 1 << 14  # points at once: few enough that temporaries stay in the caches


def morton_codes(cells: np.ndarray) -> np.ndarray:
    """Cells (N, 3), each coordinate 0 to 2^21 - 1, to codes (N,) int64: bit 3 i + a is bit i of coordinate a.

    Example:
        >>> morton_codes(np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1]])).tolist()
        [1, 2, 4]
    """
    codes = np.zeros(len(cells), np.int64)
    for first in range(0, len(cells), _BLOCK):
        part = slice(first, first + _BLOCK)
        for axis in range(3):
            bits = cells[part, axis].astype(np.int64)
            for shift, mask in _SPREAD:
                bits |= bits << shift
                bits &= mask
            bits <<= axis
            codes[part] |= bits
    return codes


def morton_cells(codes: np.ndarray) -> np.ndarray:
    """The inverse of `morton_codes`: codes (N,) int64, 0 or more, to cells (N, 3) int32."""
    cells = np.empty((len(codes), 3), np.int32)
    for first in range(0, len(codes), _BLOCK):
        part = slice(first, first + _BLOCK)
        for axis in range(3):
            bits = codes[part] >> axis
            bits &= _SPREAD[-1][1]
            for shift, mask in _GATHER:
                bits |= bits >> shift
                bits &= mask
            cells[part, axis] = bits
    return cells

"""Encoding viewing directions: a device function for kernels that decode colours."""

from __future__ import annotations

import triton
import triton.language as tl


@triton.jit
def _sin_of_turns(turns):
    """sin(2 pi t) for t in [-1/2, 3/4], to 1e-7 (the library's sine keeps a table in memory for huge arguments)."""
    turns = tl.where(turns > 0.25, 0.5 - turns, tl.where(turns < -0.25, -0.5 - turns, turns))
    square = turns * turns
    polynomial = ((39.7598271 * square - 76.5811727) * square + 81.6024764) * square - 41.3416806
    return turns * (polynomial * square + 6.28318528)


@triton.jit
def encode_block(x, y, z, FREQUENCY: tl.constexpr, FIRST: tl.constexpr, HEIGHT: tl.constexpr):
    """Rows FIRST to FIRST + HEIGHT of `directions.encode_directions` of unit vectors [BLOCK], as a tile
    [HEIGHT, BLOCK]; past the last true row, anything finite."""
    row = FIRST + tl.arange(0, HEIGHT)[:, None]
    x, y, z = x[None, :], y[None, :], z[None, :]
    if FREQUENCY:
        part = row % 12
        along = tl.where(part % 3 == 0, x, tl.where(part % 3 == 1, y, z))
        turns = along * (0.5 * (1 << part // 3).to(tl.float32))
        encoded = _sin_of_turns(turns - tl.floor(turns + 0.5) + tl.where(row < 12, 0.0, 0.25))
    else:
        encoded = tl.where(row == 0, 0.28209479177387814, 0.5462742152960396 * (x * x - y * y))
        encoded = tl.where(row == 1, 0.4886025119029199 * y, encoded)
        encoded = tl.where(row == 2, 0.4886025119029199 * z, encoded)
        encoded = tl.where(row == 3, 0.4886025119029199 * x, encoded)
        encoded = tl.where(row == 4, 1.0925484305920792 * x * y, encoded)
        encoded = tl.where(row == 5, 1.0925484305920792 * y * z, encoded)
        encoded = tl.where(row == 6, 0.31539156525252005 * (3 * z * z - 1), encoded)
        encoded = tl.where(row == 7, 1.0925484305920792 * x * z, encoded)
    return encoded

"""Which tiles an ellipse touches: device functions that counting and listing share.

In float32: spans are widened by more than it rounds, and blending decides pixel by pixel.
"""

from __future__ import annotations

import math

import triton
import triton.language as tl

from hyrfpack.ops.rasterize import reference

TILE = tl.constexpr(reference.TILE)
EXPONENT_MIN = tl.constexpr(math.log2(reference.ALPHA_MIN))
UNIT = tl.constexpr(2 * math.log(2))  # d^T Sigma^-1 d = UNIT (u^2 + v^2), see gpu_project
_SLACK = tl.constexpr(1e-3)  # of d^T Sigma^-1 d
_PAD = tl.constexpr(0.01)  # pixels ...
_ROUNDING = tl.constexpr(1e-6)  # ... and the share of far-away coordinates by which spans are widened


@triton.jit
def ellipse(mean_x, mean_y, xx, yy, u_x, u_y, log_opacity):
    """What `tile_rows` and `tile_columns` need of the ellipse alpha >= 1/255 of projected Gaussians.

    Not from xx yy - xy^2, which cancels on needles: xy / xx = -u_x / u_y and det / xx = 1 / (UNIT u_y^2).
    """
    reach = tl.maximum(log_opacity - EXPONENT_MIN, 0.0) * UNIT + _SLACK
    extent_x, extent_y = tl.sqrt(reach * xx), tl.sqrt(reach * yy)
    ratio = xx / yy
    slope = -u_x / u_y
    inv_u = 1 / u_y
    rest = ratio * inv_u * inv_u / UNIT
    # Rows at offset t from the mean span slope ratio t +- sqrt(rest (reach - t^2 / yy)), widest at t = +-turn.
    return mean_x - 0.5, mean_y - 0.5, extent_x, extent_y, reach, 1 / yy, slope * ratio, rest, slope * extent_x


@triton.jit
def _whole(low, high, last):
    """The pixels 0 to last, as integers, whose centres lie in [low, high] (given less half a pixel)."""
    first = tl.minimum(tl.ceil(tl.maximum(low, 0.0)), last + 1.0).to(tl.int32)
    return first, tl.maximum(tl.floor(tl.minimum(high, last)), -1.0).to(tl.int32)


@triton.jit
def tile_rows(shape, height):
    """The pixel rows that ellipses touch, first and last; first > last for none. A tile row is a row // TILE."""
    _, y, _, extent_y, _, _, _, _, _ = shape
    pad = extent_y + (tl.abs(y) + extent_y) * _ROUNDING + _PAD
    return _whole(y - pad, y + pad, (height - 1).to(tl.float32))


@triton.jit
def tile_columns(shape, tile_row, top, bottom, width):
    """The tiles that ellipses touch in one row of tiles.

    Args:
        shape: of `ellipse`.
        tile_row: which row of tiles.
        top, bottom: of `tile_rows`.

    Returns:
        The first tile's column and how many there are, 0 or more.
    """
    x, y, extent_x, extent_y, reach, inv_yy, slope, rest, turn = shape
    high_row, low_row = tl.maximum(top, tile_row * TILE), tl.minimum(bottom, tile_row * TILE + (TILE - 1))
    near = tl.maximum(high_row.to(tl.float32) - y, -extent_y)
    far = tl.minimum(low_row.to(tl.float32) - y, extent_y)
    t = tl.minimum(tl.maximum(turn, near), far)
    high = slope * t + tl.sqrt(rest * tl.maximum(reach - t * t * inv_yy, 0.0))
    t = tl.minimum(tl.maximum(-turn, near), far)
    low = slope * t - tl.sqrt(rest * tl.maximum(reach - t * t * inv_yy, 0.0))
    pad = (tl.abs(x) + extent_x) * _ROUNDING + _PAD
    left, right = _whole(x + low - pad, x + high + pad, (width - 1).to(tl.float32))
    found = (high_row <= low_row) & (left <= right)
    first = left // TILE
    return first, tl.where(found, right // TILE - first + 1, 0)

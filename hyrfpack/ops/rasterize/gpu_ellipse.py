"""Device functions that find the tiles an ellipse touches, for the kernels that count and list pairs.

They compute in float32. Spans are widened by more than the rounding error. Too wide a span is harmless, because
blending tests alpha at each pixel.
"""

from __future__ import annotations

import math

import triton
import triton.language as tl

from hyrfpack.ops.rasterize import reference

TILE_SIZE = tl.constexpr(reference.TILE_SIZE)
LOG2_ALPHA_MIN = tl.constexpr(math.log2(reference.ALPHA_MIN))
# d^T Sigma^-1 d = UV_SCALE (u^2 + v^2), see gpu_project.
UV_SCALE = tl.constexpr(2 * math.log(2))
# The limit of d^T Sigma^-1 d is raised by this margin against rounding errors.
_REACH_MARGIN = tl.constexpr(1e-3)
# Spans are widened by an absolute margin and by one relative to the size of the coordinates.
_SPAN_MARGIN_PIXELS = tl.constexpr(0.01)
_SPAN_MARGIN_RATIO = tl.constexpr(1e-6)


@triton.jit
def make_ellipse(mean_x, mean_y, xx, yy, u_x, u_y, log_opacity):
    """Compute the parameters of the ellipses alpha >= 1/255 of projected Gaussians.

    They are inputs of `touched_pixel_rows` and `touched_tile_columns`. The computation avoids xx yy - xy^2, which
    cancels on needles; xy / xx = -u_x / u_y and det / xx = 1 / (UV_SCALE u_y^2) do not.
    """
    reach = tl.maximum(log_opacity - LOG2_ALPHA_MIN, 0.0) * UV_SCALE + _REACH_MARGIN
    extent_x, extent_y = tl.sqrt(reach * xx), tl.sqrt(reach * yy)
    ratio = xx / yy
    slope = -u_x / u_y
    inv_u = 1 / u_y
    rest = ratio * inv_u * inv_u / UV_SCALE
    # A row at offset t from the mean spans slope ratio t +- sqrt(rest (reach - t^2 / yy)). The extremes of the whole
    # ellipse lie at t = +-turn.
    return mean_x - 0.5, mean_y - 0.5, extent_x, extent_y, reach, 1 / yy, slope * ratio, rest, slope * extent_x


@triton.jit
def _pixel_range(low, high, last):
    """Return the first and last pixel in 0 to last whose centre, minus half a pixel, lies in [low, high]."""
    first = tl.minimum(tl.ceil(tl.maximum(low, 0.0)), last + 1.0).to(tl.int32)
    return first, tl.maximum(tl.floor(tl.minimum(high, last)), -1.0).to(tl.int32)


@triton.jit
def touched_pixel_rows(shape, height):
    """Return the first and last pixel row that ellipses touch; first > last if there is none."""
    _, y, _, extent_y, _, _, _, _, _ = shape
    pad = extent_y + (tl.abs(y) + extent_y) * _SPAN_MARGIN_RATIO + _SPAN_MARGIN_PIXELS
    return _pixel_range(y - pad, y + pad, (height - 1).to(tl.float32))


@triton.jit
def touched_tile_columns(shape, tile_row, top, bottom, width):
    """Find the tiles that ellipses touch in one row of tiles.

    Args:
        shape: the result of `make_ellipse`.
        tile_row: the index of the row of tiles.
        top, bottom: the result of `touched_pixel_rows`.

    Returns:
        The first tile's column and the number of tiles, 0 or more.
    """
    x, y, extent_x, extent_y, reach, inv_yy, slope, rest, turn = shape
    high_row, low_row = (
        tl.maximum(top, tile_row * TILE_SIZE),
        tl.minimum(bottom, tile_row * TILE_SIZE + (TILE_SIZE - 1)),
    )
    near = tl.maximum(high_row.to(tl.float32) - y, -extent_y)
    far = tl.minimum(low_row.to(tl.float32) - y, extent_y)
    t = tl.minimum(tl.maximum(turn, near), far)
    high = slope * t + tl.sqrt(rest * tl.maximum(reach - t * t * inv_yy, 0.0))
    t = tl.minimum(tl.maximum(-turn, near), far)
    low = slope * t - tl.sqrt(rest * tl.maximum(reach - t * t * inv_yy, 0.0))
    pad = (tl.abs(x) + extent_x) * _SPAN_MARGIN_RATIO + _SPAN_MARGIN_PIXELS
    left, right = _pixel_range(x + low - pad, x + high + pad, (width - 1).to(tl.float32))
    found = (high_row <= low_row) & (left <= right)
    first = left // TILE_SIZE
    return first, tl.where(found, right // TILE_SIZE - first + 1, 0)

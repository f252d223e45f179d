"""Finds the median depth of the pixels of each tile, in compiled code; see cpu_blend for the conditions of speed."""

from __future__ import annotations

import numpy as np

from hyrfpack.ops.rasterize.cpu_bin import POSITION_SHIFT_BITS
from hyrfpack.ops.rasterize.cpu_blend import exp8
from hyrfpack.ops.rasterize.cpu_project import CUTOFF, DEPTH, GREEN, MEAN_X, MEAN_Y, OPACITY, RED, U_X, U_Y, V_Y
from hyrfpack.ops.rasterize.reference import ALPHA_MAX, TILE_SIZE
from hyrfpack.parallel.compiled import compiled

_kernel = compiled(fastmath={"contract", "nsz", "nnan", "reassoc", "arcp"}, error_model="numpy")
_ALPHA_MAX, _HALF = np.float32(ALPHA_MAX), np.float32(0.5)
_ZERO, _ONE = np.float32(0), np.float32(1)
_PIXELS_PER_TILE = TILE_SIZE * TILE_SIZE
_ROW_PIXELS = np.uint64(TILE_SIZE)
_UINT_1, _UINT_4, _UINT_15 = np.uint64(1), np.uint64(4), np.uint64(15)
_FINISH_TEST_MASK = np.uint64(7)


@_kernel
def median_tiles(first_tile, last_tile, tile_starts, pairs, records, max_ratio, depth):
    """Write the median depth of tiles first_tile to last_tile to depth (H, W), 0 where T stays above 1/2.

    Instead of red and green, the records hold the slopes dz/dx and dz/dy of each Gaussian's plane. `max_ratio` limits
    the depth in the plane relative to the centre's.
    """
    height, width = depth.shape
    pixel_x, pixel_y = np.empty(_PIXELS_PER_TILE, np.float32), np.empty(_PIXELS_PER_TILE, np.float32)
    transmittance, median = np.empty(_PIXELS_PER_TILE, np.float32), np.empty(_PIXELS_PER_TILE, np.float32)
    for k in range(_PIXELS_PER_TILE):
        pixel_x[k], pixel_y[k] = np.float32(k % TILE_SIZE) + _HALF, np.float32(k // TILE_SIZE) + _HALF
    tiles_x = (width + TILE_SIZE - 1) // TILE_SIZE
    for tile in range(first_tile, last_tile):
        left, top = (tile % tiles_x) * TILE_SIZE, (tile // tiles_x) * TILE_SIZE
        columns, lines = min(TILE_SIZE, width - left), min(TILE_SIZE, height - top)
        for k in range(np.uint64(_PIXELS_PER_TILE)):
            inside = (k & _UINT_15) < np.uint64(columns) and k // _ROW_PIXELS < np.uint64(lines)
            transmittance[k], median[k] = _ONE if inside else _ZERO, _ZERO
        begin, end = np.uint64(tile_starts[tile]), np.uint64(tile_starts[tile + 1])
        for pair in range(begin, end):
            packed = pairs[pair]
            g = packed >> POSITION_SHIFT_BITS
            dx, dy = np.float64(records[g, MEAN_X]) - left, np.float64(records[g, MEAN_Y]) - top
            u_x, u_y, v_y = records[g, U_X], records[g, U_Y], records[g, V_Y]
            u_0, v_0 = np.float32(u_x * dx + u_y * dy), np.float32(v_y * dy)
            cut, opacity = -records[g, CUTOFF], records[g, OPACITY]
            slope_x, slope_y = records[g, RED], records[g, GREEN]
            center = records[g, DEPTH]
            low, high = center / max_ratio, center * max_ratio
            z_0 = np.float32(np.float64(center) - slope_x * dx - slope_y * dy)
            for k in range(
                (packed & _UINT_15) * _ROW_PIXELS, (((packed >> _UINT_4) & _UINT_15) + _UINT_1) * _ROW_PIXELS
            ):
                u = u_0 - u_x * pixel_x[k] - u_y * pixel_y[k]
                v = v_0 - v_y * pixel_y[k]
                x = -(u * u + v * v)
                alpha = min(opacity * exp8(x), _ALPHA_MAX)
                alpha = alpha if x >= cut else _ZERO
                before = transmittance[k]
                after = before - alpha * before
                transmittance[k] = after
                z = min(max(z_0 + slope_x * pixel_x[k] + slope_y * pixel_y[k], low), high)
                median[k] = z if before > _HALF and after <= _HALF else median[k]
            if (pair - begin) & _FINISH_TEST_MASK == _FINISH_TEST_MASK:
                unfinished = _ZERO
                for k in range(np.uint64(_PIXELS_PER_TILE)):
                    unfinished += max(transmittance[k] - _HALF, _ZERO)
                if unfinished == _ZERO:
                    break
        for row in range(lines):
            for column in range(columns):
                depth[top + row, left + column] = median[row * TILE_SIZE + column]

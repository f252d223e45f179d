"""Blends the pairs of each tile, forward and backward, in compiled code.

LLVM vectorises the loops over pixels only under these conditions: they run over whole rows of 16 pixels without
branches, they index with uint64, and they access one scratch buffer at constant offsets. For the sums, `fastmath` must
also allow reassociation.
"""

from __future__ import annotations

import numpy as np

from hyrfpack.ops.rasterize.cpu_bin import POSITION_SHIFT_BITS, SLOT_MASK, SLOT_SHIFT_BITS
from hyrfpack.ops.rasterize.cpu_prefetch import prefetch_row, prefetch_row_for_write
from hyrfpack.ops.rasterize.cpu_project import (
    BLUE,
    CUTOFF,
    DEPTH,
    GRADIENT_ROW_FLOATS,
    GREEN,
    MEAN_X,
    MEAN_Y,
    OPACITY,
    RED,
    SUM_ABS_U,
    SUM_ABS_V,
    SUM_BLUE,
    SUM_GREEN,
    SUM_P,
    SUM_RED,
    SUM_U,
    SUM_UU,
    SUM_UV,
    SUM_V,
    SUM_VV,
    U_X,
    U_Y,
    V_Y,
)
from hyrfpack.ops.rasterize.reference import ALPHA_MAX, TILE_SIZE
from hyrfpack.parallel.compiled import compiled

_kernel = compiled(fastmath={"contract", "nsz", "nnan", "reassoc", "arcp"}, error_model="numpy")
# Constants are typed, so that values stay float32 and indices uint64 in the kernels.
_ALPHA_MAX = np.float32(ALPHA_MAX)
_ZERO, _ONE = np.float32(0), np.float32(1)
_PIXELS_PER_TILE = TILE_SIZE * TILE_SIZE
_ROW_PIXELS = np.uint64(TILE_SIZE)
_UINT_1, _UINT_4, _UINT_15 = np.uint64(1), np.uint64(4), np.uint64(15)
# Offsets of the planes of the scratch buffer, 256 floats each: pixel centres x and y, transmittance T, red, green, blue
# and depth. Backward keeps dL/d(rgb) in the colour planes and the rest R in the depth plane.
_X_PLANE, _Y_PLANE, _T_PLANE, _RED_PLANE, _GREEN_PLANE, _BLUE_PLANE, _DEPTH_PLANE = (
    np.uint64(_PIXELS_PER_TILE * i) for i in range(7)
)
_PREFETCH_DISTANCE_PAIRS = np.uint64(6)
# After every 8 pairs, when these bits of the count are 0, a tile tests whether any pixel is still unfinished.
_FINISH_TEST_MASK = np.uint64(7)
# Coefficients of a polynomial for exp(x) on [-ln 2, 0] with a relative error of 8e-8. Iterated least squares minimised
# the maximum of the relative error.
_EXP_0, _EXP_1, _EXP_2 = np.float32(0.99999993), np.float32(0.99999289), np.float32(0.49988692)
_EXP_3, _EXP_4, _EXP_5 = np.float32(0.16599276), np.float32(0.03980572), np.float32(0.00586717)


@_kernel
def exp8(x):
    """Return exp(8 x) for x in [-ln 2, 0] to a relative error of 2e-6; for smaller x, a positive number or infinity."""
    e = ((((_EXP_5 * x + _EXP_4) * x + _EXP_3) * x + _EXP_2) * x + _EXP_1) * x + _EXP_0
    e *= e
    e *= e
    return e * e


@_kernel
def _scratch(planes):
    """Allocate planes aligned to cache lines. The first two hold the pixel centres relative to the tile's corner."""
    buffer = np.empty(planes * _PIXELS_PER_TILE + 16, np.float32)
    skip = (-np.int64(buffer.ctypes.data) // 4) % 16
    buffer = buffer[skip : skip + planes * _PIXELS_PER_TILE]
    for k in range(_PIXELS_PER_TILE):
        buffer[np.uint64(k) + _X_PLANE] = np.float32(k % TILE_SIZE) + np.float32(0.5)
        buffer[np.uint64(k) + _Y_PLANE] = np.float32(k // TILE_SIZE) + np.float32(0.5)
    return buffer


@_kernel
def blend_tiles(
    first_tile, last_tile, tile_starts, pairs, records, transmittance_min, rgb, transmittance, depth, pair_weights,
    blended,
):  # fmt: skip
    """Blend tiles first_tile to last_tile into rgb (H, W, 3), transmittance (H, W) and depth (H, W).

    Args:
        rgb, depth: None if not needed.
        pair_weights: (P,) zeros. The sum of T alpha over pixels is written to each pair's slot. None if not needed.
        blended: (tiles,), written: the number of pairs after which each tile was finished.
    """
    height, width = transmittance.shape
    s = _scratch(7)
    tiles_x = (width + TILE_SIZE - 1) // TILE_SIZE
    for tile in range(first_tile, last_tile):
        left, top = (tile % tiles_x) * TILE_SIZE, (tile // tiles_x) * TILE_SIZE
        columns, lines = min(TILE_SIZE, width - left), min(TILE_SIZE, height - top)
        # T < 0 marks a pixel outside the image; nothing is blended there, as in a finished pixel.
        for k in range(np.uint64(_PIXELS_PER_TILE)):
            inside = (k & _UINT_15) < np.uint64(columns) and k // _ROW_PIXELS < np.uint64(lines)
            s[k + _T_PLANE] = _ONE if inside else -_ONE
            s[k + _RED_PLANE] = s[k + _GREEN_PLANE] = s[k + _BLUE_PLANE] = s[k + _DEPTH_PLANE] = _ZERO
        begin, end = np.uint64(tile_starts[tile]), np.uint64(tile_starts[tile + 1])
        pair = begin
        while pair < end:
            packed = pairs[pair]
            g = packed >> POSITION_SHIFT_BITS
            prefetch_row(records, pairs[min(pair + _PREFETCH_DISTANCE_PAIRS, end - _UINT_1)] >> POSITION_SHIFT_BITS)
            dx, dy = np.float64(records[g, MEAN_X]) - left, np.float64(records[g, MEAN_Y]) - top
            u_x, u_y, v_y = records[g, U_X], records[g, U_Y], records[g, V_Y]
            u_0, v_0 = np.float32(u_x * dx + u_y * dy), np.float32(v_y * dy)
            cut, opacity = -records[g, CUTOFF], records[g, OPACITY]
            red, green, blue, z = records[g, RED], records[g, GREEN], records[g, BLUE], records[g, DEPTH]
            total = _ZERO
            for k in range(
                (packed & _UINT_15) * _ROW_PIXELS, (((packed >> _UINT_4) & _UINT_15) + _UINT_1) * _ROW_PIXELS
            ):
                u = u_0 - u_x * s[k + _X_PLANE] - u_y * s[k + _Y_PLANE]
                v = v_0 - v_y * s[k + _Y_PLANE]
                x = -(u * u + v * v)
                alpha = min(opacity * exp8(x), _ALPHA_MAX)
                alpha = alpha if x >= cut else _ZERO
                t = s[k + _T_PLANE]
                weight = alpha * t if t > transmittance_min else _ZERO
                s[k + _T_PLANE] = t - weight
                if rgb is not None:
                    s[k + _RED_PLANE] += weight * red
                    s[k + _GREEN_PLANE] += weight * green
                    s[k + _BLUE_PLANE] += weight * blue
                if depth is not None:
                    s[k + _DEPTH_PLANE] += weight * z
                if pair_weights is not None:
                    total += weight
            if pair_weights is not None:
                pair_weights[(packed >> SLOT_SHIFT_BITS) & SLOT_MASK] = total
            pair += _UINT_1
            if (pair - begin) & _FINISH_TEST_MASK == np.uint64(0):
                unfinished = _ZERO  # Pixels are summed, because a maximum would not be vectorised.
                for k in range(np.uint64(_PIXELS_PER_TILE)):
                    unfinished += max(s[k + _T_PLANE] - transmittance_min, _ZERO)
                if unfinished == _ZERO:
                    break
        blended[tile] = pair - begin
        for row in range(lines):
            for column in range(columns):
                k = np.uint64(row * TILE_SIZE + column)
                t = s[k + _T_PLANE]
                transmittance[top + row, left + column] = t
                if rgb is not None:
                    rgb[top + row, left + column, 0] = s[k + _RED_PLANE]
                    rgb[top + row, left + column, 1] = s[k + _GREEN_PLANE]
                    rgb[top + row, left + column, 2] = s[k + _BLUE_PLANE]
                if depth is not None:
                    depth[top + row, left + column] = s[k + _DEPTH_PLANE] / (_ONE - t) if t < _ONE else _ZERO


@_kernel
def sum_slots(start, stop, slot_starts, values, sums):
    """Write the sum of `values` (P,) over each Gaussian's slots to `sums` (N,), for Gaussians start to stop.

    slot_starts: (N + 1,) the first slot of each Gaussian.
    """
    for i in range(np.uint64(start), np.uint64(stop)):
        total = _ZERO
        for slot in range(np.uint64(slot_starts[i]), np.uint64(slot_starts[i + np.uint64(1)])):
            total += values[slot]
        sums[i] = total


@_kernel
def blend_tiles_backward(
    first_tile, last_tile, tile_starts, pairs, blended, records, transmittance_min, image, gradient, absgrad,
    gradient_rows,
):  # fmt: skip
    """Write the gradient row of each pair of tiles first_tile to last_tile at the pair's slot.

    `image` and `gradient` are rgb (H, W, 3) and transmittance (H, W) of the image, and the gradients of both.

    Blending is replayed front to back with the rest R, the contribution to g . rgb of everything behind a Gaussian.
    Then dL/d(alpha) = T (color . g) - R / (1 - alpha) needs no values stored by forward. The sums for absgrad take a
    tenth of the time and are skipped if it is None; the array itself is not accessed.
    """
    (rgb, transmittance), (grad_rgb, grad_transmittance) = image, gradient
    height, width = transmittance.shape
    s = _scratch(7)
    tiles_x = (width + TILE_SIZE - 1) // TILE_SIZE
    for tile in range(first_tile, last_tile):
        left, top = (tile % tiles_x) * TILE_SIZE, (tile // tiles_x) * TILE_SIZE
        columns, lines = min(TILE_SIZE, width - left), min(TILE_SIZE, height - top)
        for k in range(np.uint64(_PIXELS_PER_TILE)):
            s[k + _T_PLANE] = -_ONE
            s[k + _RED_PLANE] = s[k + _GREEN_PLANE] = s[k + _BLUE_PLANE] = s[k + _DEPTH_PLANE] = _ZERO
        for row in range(lines):
            for column in range(columns):
                k = np.uint64(row * TILE_SIZE + column)
                y, x = top + row, left + column
                g_0, g_1, g_2 = grad_rgb[y, x, 0], grad_rgb[y, x, 1], grad_rgb[y, x, 2]
                s[k + _T_PLANE] = _ONE
                s[k + _RED_PLANE], s[k + _GREEN_PLANE], s[k + _BLUE_PLANE] = g_0, g_1, g_2
                s[k + _DEPTH_PLANE] = (
                    rgb[y, x, 0] * g_0 + rgb[y, x, 1] * g_1 + rgb[y, x, 2] * g_2
                    + transmittance[y, x] * grad_transmittance[y, x]
                )  # fmt: skip
        begin, end = np.uint64(tile_starts[tile]), np.uint64(tile_starts[tile + 1])
        finish = begin + np.uint64(blended[tile])
        for pair in range(begin, finish):
            packed = pairs[pair]
            g = packed >> POSITION_SHIFT_BITS
            ahead = pairs[min(pair + _PREFETCH_DISTANCE_PAIRS, end - _UINT_1)]
            prefetch_row(records, ahead >> POSITION_SHIFT_BITS)
            prefetch_row_for_write(gradient_rows, (ahead >> SLOT_SHIFT_BITS) & SLOT_MASK)
            dx, dy = np.float64(records[g, MEAN_X]) - left, np.float64(records[g, MEAN_Y]) - top
            u_x, u_y, v_y = records[g, U_X], records[g, U_Y], records[g, V_Y]
            u_0, v_0 = np.float32(u_x * dx + u_y * dy), np.float32(v_y * dy)
            cut, opacity = -records[g, CUTOFF], records[g, OPACITY]
            red, green, blue = records[g, RED], records[g, GREEN], records[g, BLUE]
            su = sv = suu = suv = svv = sp = sr = sg = sb = sau = sav = _ZERO
            for k in range(
                (packed & _UINT_15) * _ROW_PIXELS, (((packed >> _UINT_4) & _UINT_15) + _UINT_1) * _ROW_PIXELS
            ):
                u = u_0 - u_x * s[k + _X_PLANE] - u_y * s[k + _Y_PLANE]
                v = v_0 - v_y * s[k + _Y_PLANE]
                x = -(u * u + v * v)
                uncut = opacity * exp8(x)
                alpha = min(uncut, _ALPHA_MAX)
                t = s[k + _T_PLANE]
                alpha = alpha if x >= cut and t > transmittance_min else _ZERO
                weight = alpha * t
                s[k + _T_PLANE] = t - weight
                g_0, g_1, g_2 = s[k + _RED_PLANE], s[k + _GREEN_PLANE], s[k + _BLUE_PLANE]
                contribution = weight * (red * g_0 + green * g_1 + blue * g_2)
                rest = s[k + _DEPTH_PLANE] - contribution
                s[k + _DEPTH_PLANE] = rest
                p = contribution - rest * alpha / (_ONE - alpha)
                p = p if uncut <= _ALPHA_MAX else _ZERO
                pu, pv = p * u, p * v
                sp += p
                su += pu
                sv += pv
                suu += pu * u
                suv += pu * v
                svv += pv * v
                sr += weight * g_0
                sg += weight * g_1
                sb += weight * g_2
                if absgrad is not None:
                    sau += abs(pu)
                    sav += abs(u_y * pu + v_y * pv)
            slot = (packed >> SLOT_SHIFT_BITS) & SLOT_MASK
            gradient_rows[slot, SUM_U], gradient_rows[slot, SUM_V] = su, sv
            gradient_rows[slot, SUM_UU], gradient_rows[slot, SUM_UV], gradient_rows[slot, SUM_VV] = suu, suv, svv
            gradient_rows[slot, SUM_P] = sp
            gradient_rows[slot, SUM_RED], gradient_rows[slot, SUM_GREEN], gradient_rows[slot, SUM_BLUE] = sr, sg, sb
            gradient_rows[slot, SUM_ABS_U], gradient_rows[slot, SUM_ABS_V] = sau, sav
        for pair in range(finish, end):
            for column in range(np.uint64(GRADIENT_ROW_FLOATS)):
                gradient_rows[(pairs[pair] >> SLOT_SHIFT_BITS) & SLOT_MASK, column] = _ZERO

"""Compiled blending, forward and backward, of the tiles that binning filled.

The loops over pixels are flat over whole rows of 16 and free of branches, index with uint64 and touch one scratch
buffer at constant offsets: LLVM vectorises nothing less. `fastmath` must allow reassociation for the sums.
"""

from __future__ import annotations

import numpy as np

from hyrfpack.ops.rasterize.cpu_bin import POSITION_SHIFT, SLOT_MASK, SLOT_SHIFT
from hyrfpack.ops.rasterize.cpu_prefetch import prefetch_row, prefetch_row_for_write
from hyrfpack.ops.rasterize.cpu_project import (
    BLUE,
    CUT,
    DEPTH,
    GREEN,
    MEAN_X,
    MEAN_Y,
    OPACITY,
    RED,
    ROW,
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
from hyrfpack.ops.rasterize.reference import ALPHA_MAX, TILE
from hyrfpack.parallel.compiled import compiled

_kernel = compiled(fastmath={"contract", "nsz", "nnan", "reassoc", "arcp"}, error_model="numpy")
_CAP = np.float32(ALPHA_MAX)
_ZERO, _ONE = np.float32(0), np.float32(1)
_PIXELS = TILE * TILE
_SIDE, _U1, _FOUR, _U15 = np.uint64(TILE), np.uint64(1), np.uint64(4), np.uint64(15)
# Planes of the scratch buffer, 256 floats each.
_X, _Y, _T, _P0, _P1, _P2, _P3 = (np.uint64(_PIXELS * i) for i in range(7))
_AHEAD = np.uint64(6)  # pairs by which records are prefetched
_CHECK_EVERY = np.uint64(7)  # a tile asks after each 8 Gaussians whether any pixel still takes light
# exp(x) on [-ln 2, 0] to a relative error of 8e-8: least maximum of the relative error, by iterated least squares.
_E0, _E1, _E2 = np.float32(0.99999993), np.float32(0.99999289), np.float32(0.49988692)
_E3, _E4, _E5 = np.float32(0.16599276), np.float32(0.03980572), np.float32(0.00586717)


@_kernel
def _exp8(x):
    """exp(8 x) for x in [-ln 2, 0], relative error 2e-6; some positive number or infinity below."""
    e = ((((_E5 * x + _E4) * x + _E3) * x + _E2) * x + _E1) * x + _E0
    e *= e
    e *= e
    return e * e


@_kernel
def _scratch(planes):
    """A buffer of planes, aligned to cache lines, its first two the pixel centres from the tile's corner."""
    buffer = np.empty(planes * _PIXELS + 16, np.float32)
    skip = (-np.int64(buffer.ctypes.data) // 4) % 16
    buffer = buffer[skip : skip + planes * _PIXELS]
    for k in range(_PIXELS):
        buffer[np.uint64(k) + _X] = np.float32(k % TILE) + np.float32(0.5)
        buffer[np.uint64(k) + _Y] = np.float32(k // TILE) + np.float32(0.5)
    return buffer


@_kernel
def blend_tiles(
    first_tile, last_tile, tile_starts, pairs, records, width, height, transmittance_min,
    rgb, transmittance, depth, light, blended,
):  # fmt: skip
    """Blend tiles first_tile to last_tile into rgb (H, W, 3), transmittance (H, W) and depth (H, W).

    rgb and depth may be None, where nobody wants them, and so may light: (P,) zeros, to which each pair's sum over
    pixels of T alpha is written at its slot. blended: (tiles,) after how many pairs each tile was finished.
    """
    s = _scratch(7)
    tiles_x = (width + TILE - 1) // TILE
    for tile in range(first_tile, last_tile):
        left, top = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
        columns, lines = min(TILE, width - left), min(TILE, height - top)
        # T < 0 marks a pixel outside of the picture; it takes as little as one that is finished.
        for k in range(np.uint64(_PIXELS)):
            inside = (k & _U15) < np.uint64(columns) and k // _SIDE < np.uint64(lines)
            s[k + _T] = _ONE if inside else -_ONE
            s[k + _P0] = s[k + _P1] = s[k + _P2] = s[k + _P3] = _ZERO
        begin, end = np.uint64(tile_starts[tile]), np.uint64(tile_starts[tile + 1])
        pair = begin
        while pair < end:
            packed = pairs[pair]
            g = packed >> POSITION_SHIFT
            prefetch_row(records, pairs[min(pair + _AHEAD, end - _U1)] >> POSITION_SHIFT)
            dx, dy = np.float64(records[g, MEAN_X]) - left, np.float64(records[g, MEAN_Y]) - top
            u_x, u_y, v_y = records[g, U_X], records[g, U_Y], records[g, V_Y]
            u_0, v_0 = np.float32(u_x * dx + u_y * dy), np.float32(v_y * dy)
            cut, opacity = -records[g, CUT], records[g, OPACITY]
            red, green, blue, z = records[g, RED], records[g, GREEN], records[g, BLUE], records[g, DEPTH]
            total = _ZERO
            for k in range((packed & _U15) * _SIDE, (((packed >> _FOUR) & _U15) + _U1) * _SIDE):
                u = u_0 - u_x * s[k + _X] - u_y * s[k + _Y]
                v = v_0 - v_y * s[k + _Y]
                x = -(u * u + v * v)
                alpha = min(opacity * _exp8(x), _CAP)
                alpha = alpha if x >= cut else _ZERO
                t = s[k + _T]
                weight = alpha * t if t > transmittance_min else _ZERO
                s[k + _T] = t - weight
                if rgb is not None:
                    s[k + _P0] += weight * red
                    s[k + _P1] += weight * green
                    s[k + _P2] += weight * blue
                if depth is not None:
                    s[k + _P3] += weight * z
                if light is not None:
                    total += weight
            if light is not None:
                light[(packed >> SLOT_SHIFT) & SLOT_MASK] = total
            pair += _U1
            if (pair - begin) & _CHECK_EVERY == np.uint64(0):
                going = _ZERO  # a sum, for a maximum would not be vectorised
                for k in range(np.uint64(_PIXELS)):
                    going += max(s[k + _T] - transmittance_min, _ZERO)
                if going == _ZERO:
                    break
        blended[tile] = pair - begin
        for row in range(lines):
            for column in range(columns):
                k = np.uint64(row * TILE + column)
                t = s[k + _T]
                transmittance[top + row, left + column] = t
                if rgb is not None:
                    rgb[top + row, left + column, 0] = s[k + _P0]
                    rgb[top + row, left + column, 1] = s[k + _P1]
                    rgb[top + row, left + column, 2] = s[k + _P2]
                if depth is not None:
                    depth[top + row, left + column] = s[k + _P3] / (_ONE - t) if t < _ONE else _ZERO


@_kernel
def sum_slots(start, stop, first, values, sums):
    """Write the sums (N,) of what Gaussians start to stop have at their slots (P,), which begin at first (N + 1,)."""
    for i in range(np.uint64(start), np.uint64(stop)):
        total = _ZERO
        for slot in range(np.uint64(first[i]), np.uint64(first[i + np.uint64(1)])):
            total += values[slot]
        sums[i] = total


@_kernel
def blend_tiles_backward(
    first_tile, last_tile, tile_starts, pairs, blended, records, width, height, transmittance_min,
    rgb, transmittance, grad_rgb, grad_transmittance, absgrad, gradient_rows,
):  # fmt: skip
    """Write the gradient row of each pair of tiles first_tile to last_tile at the pair's slot.

    Replays the blending front to back with the rest R = (what lies behind), so that
    dL/d(alpha) = T (color . g) - R / (1 - alpha) needs nothing stored in forward. absgrad is only asked whether it is
    None: its sums cost a tenth of the time.
    """
    s = _scratch(7)
    tiles_x = (width + TILE - 1) // TILE
    for tile in range(first_tile, last_tile):
        left, top = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
        columns, lines = min(TILE, width - left), min(TILE, height - top)
        for k in range(np.uint64(_PIXELS)):
            s[k + _T] = -_ONE
            s[k + _P0] = s[k + _P1] = s[k + _P2] = s[k + _P3] = _ZERO
        for row in range(lines):
            for column in range(columns):
                k = np.uint64(row * TILE + column)
                y, x = top + row, left + column
                g_0, g_1, g_2 = grad_rgb[y, x, 0], grad_rgb[y, x, 1], grad_rgb[y, x, 2]
                s[k + _T] = _ONE
                s[k + _P0], s[k + _P1], s[k + _P2] = g_0, g_1, g_2
                s[k + _P3] = (
                    rgb[y, x, 0] * g_0 + rgb[y, x, 1] * g_1 + rgb[y, x, 2] * g_2
                    + transmittance[y, x] * grad_transmittance[y, x]
                )  # fmt: skip
        begin, end = np.uint64(tile_starts[tile]), np.uint64(tile_starts[tile + 1])
        finish = begin + np.uint64(blended[tile])
        for pair in range(begin, finish):
            packed = pairs[pair]
            g = packed >> POSITION_SHIFT
            ahead = pairs[min(pair + _AHEAD, end - _U1)]
            prefetch_row(records, ahead >> POSITION_SHIFT)
            prefetch_row_for_write(gradient_rows, (ahead >> SLOT_SHIFT) & SLOT_MASK)
            dx, dy = np.float64(records[g, MEAN_X]) - left, np.float64(records[g, MEAN_Y]) - top
            u_x, u_y, v_y = records[g, U_X], records[g, U_Y], records[g, V_Y]
            u_0, v_0 = np.float32(u_x * dx + u_y * dy), np.float32(v_y * dy)
            cut, opacity = -records[g, CUT], records[g, OPACITY]
            red, green, blue = records[g, RED], records[g, GREEN], records[g, BLUE]
            su = sv = suu = suv = svv = sp = sr = sg = sb = sau = sav = _ZERO
            for k in range((packed & _U15) * _SIDE, (((packed >> _FOUR) & _U15) + _U1) * _SIDE):
                u = u_0 - u_x * s[k + _X] - u_y * s[k + _Y]
                v = v_0 - v_y * s[k + _Y]
                x = -(u * u + v * v)
                uncut = opacity * _exp8(x)
                alpha = min(uncut, _CAP)
                t = s[k + _T]
                alpha = alpha if x >= cut and t > transmittance_min else _ZERO
                weight = alpha * t
                s[k + _T] = t - weight
                g_0, g_1, g_2 = s[k + _P0], s[k + _P1], s[k + _P2]
                light = weight * (red * g_0 + green * g_1 + blue * g_2)
                rest = s[k + _P3] - light
                s[k + _P3] = rest
                p = light - rest * alpha / (_ONE - alpha)
                p = p if uncut <= _CAP else _ZERO
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
            slot = (packed >> SLOT_SHIFT) & SLOT_MASK
            gradient_rows[slot, SUM_U], gradient_rows[slot, SUM_V] = su, sv
            gradient_rows[slot, SUM_UU], gradient_rows[slot, SUM_UV], gradient_rows[slot, SUM_VV] = suu, suv, svv
            gradient_rows[slot, SUM_P] = sp
            gradient_rows[slot, SUM_RED], gradient_rows[slot, SUM_GREEN], gradient_rows[slot, SUM_BLUE] = sr, sg, sb
            gradient_rows[slot, SUM_ABS_U], gradient_rows[slot, SUM_ABS_V] = sau, sav
        for pair in range(finish, end):
            for column in range(np.uint64(ROW)):
                gradient_rows[(pairs[pair] >> SLOT_SHIFT) & SLOT_MASK, column] = _ZERO

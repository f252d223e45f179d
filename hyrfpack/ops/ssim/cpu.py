"""Computes L1, SSIM and their gradient in one pass over the image, in Numba.

A task processes one tile from top to bottom. It reads each row of the two images once and blurs it horizontally into
local moments. 8 such rows and the 10 before them are blurred vertically, which gives SSIM and its derivatives with
respect to the moments. The derivatives are blurred horizontally and vertically in the same way into the gradient: the
window is symmetric, so the blur is its own transpose.

Pixels stay interleaved, so a horizontal neighbour is 3 floats away. All rows of a task lie in one buffer at constant
offsets, so that the loops vectorise without alias checks and the data stays in the L2 cache.
"""

from __future__ import annotations

import numba
import numpy as np

from hyrfpack.ops.ssim.reference import C1, C2, WINDOW_RADIUS, window_weights
from hyrfpack.parallel.compiled import compiled
from hyrfpack.parallel.pool import run_tasks

# With error_model="numpy", divisions do not test for zero; such a test would keep the loop from vectorising.
_FAST_MATH = {"contract", "nsz", "nnan", "reassoc", "arcp"}
njit = compiled(fastmath=_FAST_MATH, error_model="numpy")
# Inlining is forced. A helper that stays a call is linked from its own object right after compilation, but from the
# caller's object when that is loaded from the cache. These two may round differently.
inlined = numba.njit(fastmath=_FAST_MATH, error_model="numpy", forceinline=True)

_MAX_TILE_COLUMNS = 236
_MAX_TILE_ROWS = 128
_ROWS_PER_GROUP = 4  # Rows that are blurred vertically together share most of their loads.
_ROWS_PER_STEP = 2 * _ROWS_PER_GROUP
_CARRIED_ROWS = 2 * WINDOW_RADIUS

# Sizes and offsets in the buffer, in floats. A row starts at column -10 of the tile for pixels x and y, at -5 for
# moments, and at 0 for the gradient.
_ROW_FLOATS = np.uint64(3 * (_MAX_TILE_COLUMNS + 4 * WINDOW_RADIUS) + 64)
_PLANE_FLOATS = _ROW_FLOATS * np.uint64(_CARRIED_ROWS + _ROWS_PER_STEP)
_X_OFFSET = np.uint64(0)
_Y_OFFSET = _ROW_FLOATS
_SSIM_OFFSET = np.uint64(2) * _ROW_FLOATS
# Derivatives of SSIM with respect to E[x], E[xx + yy] and E[xy] along one row.
_BY_X_OFFSET = np.uint64(3) * _ROW_FLOATS
_BY_SQUARE_OFFSET = np.uint64(4) * _ROW_FLOATS
_BY_PRODUCT_OFFSET = np.uint64(5) * _ROW_FLOATS
# Planes of one group of rows, blurred in both directions: 4 of moments, later 3 of derivatives.
_BLURRED_OFFSET = np.uint64(6) * _ROW_FLOATS
_BLURRED_PLANE_FLOATS = np.uint64(_ROWS_PER_GROUP) * _ROW_FLOATS
# 4 planes of x, y, xx + yy and xy, blurred horizontally.
_MOMENTS_OFFSET = _BLURRED_OFFSET + np.uint64(4) * _BLURRED_PLANE_FLOATS
# 3 planes of the derivatives with respect to E[x], E[xx + yy] and E[xy], blurred horizontally.
_DERIVATIVES_OFFSET = _MOMENTS_OFFSET + np.uint64(4) * _PLANE_FLOATS
_BUFFER_FLOATS = int(_DERIVATIVES_OFFSET + np.uint64(3) * _PLANE_FLOATS)

# Constants are typed, so that indices stay uint64 and values float32 in the kernels.
_U1, _U2, _U3 = np.uint64(1), np.uint64(2), np.uint64(3)
# Window weights by distance from the centre, in pixels.
_W5, _W4, _W3, _W2, _W1, _W0 = (np.float32(weight) for weight in window_weights()[: WINDOW_RADIUS + 1])
_C1, _C2, _TWO = np.float32(C1), np.float32(C2), np.float32(2)


@inlined
def _blur(a0, a1, a2, a3, a4, a5, a6, a7, a8, a9, a10):
    """Return the windowed mean of 11 values."""
    return _W0 * a5 + _W1 * (a4 + a6) + _W2 * (a3 + a7) + _W3 * (a2 + a8) + _W4 * (a1 + a9) + _W5 * (a0 + a10)


@inlined
def _blur_across(buffer, source, target, count):
    """Blur one row horizontally."""
    for j in range(count):
        i = source + np.uint64(j)
        buffer[target + np.uint64(j)] = _blur(
            buffer[i],
            buffer[i + np.uint64(3)],
            buffer[i + np.uint64(6)],
            buffer[i + np.uint64(9)],
            buffer[i + np.uint64(12)],
            buffer[i + np.uint64(15)],
            buffer[i + np.uint64(18)],
            buffer[i + np.uint64(21)],
            buffer[i + np.uint64(24)],
            buffer[i + np.uint64(27)],
            buffer[i + np.uint64(30)],
        )


@inlined
def _symmetric_sums(buffer, i, k):
    """Return the sums of x, y, xx + yy and xy over the two pixels k floats left and right of the window's centre."""
    left, right = i + np.uint64(15) - k, i + np.uint64(15) + k
    x0, x1, y0, y1 = (
        buffer[_X_OFFSET + left],
        buffer[_X_OFFSET + right],
        buffer[_Y_OFFSET + left],
        buffer[_Y_OFFSET + right],
    )
    return x0 + x1, y0 + y1, x0 * x0 + x1 * x1 + (y0 * y0 + y1 * y1), x0 * y0 + x1 * y1


@inlined
def _moments_across(buffer, target, count):
    """Blur x, y, xx + yy and xy of the row in the buffer horizontally."""
    for j in range(count):
        j = np.uint64(j)
        x, y = buffer[_X_OFFSET + j + np.uint64(15)], buffer[_Y_OFFSET + j + np.uint64(15)]
        x1, y1, s1, p1 = _symmetric_sums(buffer, j, np.uint64(3))
        x2, y2, s2, p2 = _symmetric_sums(buffer, j, np.uint64(6))
        x3, y3, s3, p3 = _symmetric_sums(buffer, j, np.uint64(9))
        x4, y4, s4, p4 = _symmetric_sums(buffer, j, np.uint64(12))
        x5, y5, s5, p5 = _symmetric_sums(buffer, j, np.uint64(15))
        i = target + j
        buffer[i] = _W0 * x + _W1 * x1 + _W2 * x2 + _W3 * x3 + _W4 * x4 + _W5 * x5
        buffer[i + _PLANE_FLOATS] = _W0 * y + _W1 * y1 + _W2 * y2 + _W3 * y3 + _W4 * y4 + _W5 * y5
        square = _W0 * (x * x + y * y) + _W1 * s1 + _W2 * s2 + _W3 * s3 + _W4 * s4 + _W5 * s5
        buffer[i + _U2 * _PLANE_FLOATS] = square
        buffer[i + _U3 * _PLANE_FLOATS] = _W0 * (x * y) + _W1 * p1 + _W2 * p2 + _W3 * p3 + _W4 * p4 + _W5 * p5


@inlined
def _blur_down(buffer, source, target, count):
    """Blur 14 rows vertically into a group of 4."""
    for j in range(count):
        i, o = source + np.uint64(j), target + np.uint64(j)
        a0, a1 = buffer[i], buffer[i + _ROW_FLOATS]
        a2, a3 = buffer[i + np.uint64(2) * _ROW_FLOATS], buffer[i + np.uint64(3) * _ROW_FLOATS]
        a4, a5 = buffer[i + np.uint64(4) * _ROW_FLOATS], buffer[i + np.uint64(5) * _ROW_FLOATS]
        a6, a7 = buffer[i + np.uint64(6) * _ROW_FLOATS], buffer[i + np.uint64(7) * _ROW_FLOATS]
        a8, a9 = buffer[i + np.uint64(8) * _ROW_FLOATS], buffer[i + np.uint64(9) * _ROW_FLOATS]
        a10, a11 = buffer[i + np.uint64(10) * _ROW_FLOATS], buffer[i + np.uint64(11) * _ROW_FLOATS]
        a12, a13 = buffer[i + np.uint64(12) * _ROW_FLOATS], buffer[i + np.uint64(13) * _ROW_FLOATS]
        buffer[o] = _blur(a0, a1, a2, a3, a4, a5, a6, a7, a8, a9, a10)
        buffer[o + _ROW_FLOATS] = _blur(a1, a2, a3, a4, a5, a6, a7, a8, a9, a10, a11)
        buffer[o + _U2 * _ROW_FLOATS] = _blur(a2, a3, a4, a5, a6, a7, a8, a9, a10, a11, a12)
        buffer[o + _U3 * _ROW_FLOATS] = _blur(a3, a4, a5, a6, a7, a8, a9, a10, a11, a12, a13)


@inlined
def _compute_ssim_row(buffer, source, start, count):
    """Compute SSIM and its derivatives with respect to E[x], E[xx + yy] and E[xy] along one row of moments."""
    for j in range(count):
        j = start + np.uint64(j)
        i = source + j
        x, y = buffer[i], buffer[i + _BLURRED_PLANE_FLOATS]
        square, product = buffer[i + _U2 * _BLURRED_PLANE_FLOATS], buffer[i + _U3 * _BLURRED_PLANE_FLOATS]
        means = x * y
        energy = x * x + y * y
        a1, a2 = _TWO * means + _C1, _TWO * (product - means) + _C2
        b1, b2 = energy + _C1, square - energy + _C2
        scale = np.float32(1) / (b1 * b2)
        ssim = a1 * a2 * scale
        by_square, by_product = -ssim * b1 * scale, _TWO * a1 * scale
        buffer[_SSIM_OFFSET + j] = ssim
        buffer[_BY_SQUARE_OFFSET + j] = by_square
        buffer[_BY_PRODUCT_OFFSET + j] = by_product
        buffer[_BY_X_OFFSET + j] = y * (_TWO * a2 * scale - by_product) - _TWO * x * (ssim * b2 * scale + by_square)


@inlined
def _carry_rows(buffer, plane):
    """Copy the last rows of a plane to its start, where the next step reads them."""
    step = np.uint64(_ROWS_PER_STEP) * _ROW_FLOATS
    for j in range(np.uint64(_CARRIED_ROWS) * _ROW_FLOATS):
        buffer[plane + np.uint64(j)] = buffer[plane + step + np.uint64(j)]


@inlined
def _clear(buffer, target, count):
    """Set `count` floats from `target` on to zero."""
    for j in range(count):
        buffer[target + np.uint64(j)] = np.float32(0)


@inlined
def _copy_row(pixels, row, start, count, buffer, target):
    """Copy `count` floats of a row, starting at `start`, with zeros outside the image."""
    for j in range(count):
        i = start + j
        inside = 0 <= i < pixels.shape[1]
        buffer[target + np.uint64(j)] = pixels[row, i] if inside else np.float32(0)


@njit
def _sum_differences(image, target, row, start, count):
    """Return the sum of |x - y| along a row, from one float on."""
    total = np.float32(0)
    for j in range(count):
        total += abs(image[row, start + j] - target[row, start + j])
    return total


@njit
def _process_tile(image, target, weight, l1_scale, ssim_scale, top, bottom, left, right, grad, sums):
    """Compute the gradient and the sums of |x - y| and of SSIM for rows [top, bottom) and columns [left, right).

    `weight` is 1 for values to include and 0 for others; if it has no rows, all values are included. If `grad` has no
    rows, no gradient is computed.
    """
    buffer = np.zeros(_BUFFER_FLOATS, np.float32)
    height, floats = image.shape[0], image.shape[1]
    weighted, needs_gradient = weight.shape[0] == height, grad.shape[0] == height
    first_float = 3 * left
    tile_floats = 3 * (right - left)
    moment_floats = tile_floats + 6 * WINDOW_RADIUS
    # Padding avoids remainders in vectorised loops; rows of the buffer have room for it.
    padded_floats = (moment_floats + 31) // 32 * 32
    # The part of a row of moments whose window centres lie inside the image.
    start, stop = max(0, 3 * WINDOW_RADIUS - first_float), min(moment_floats, floats - first_float + 3 * WINDOW_RADIUS)
    total_l1, total_ssim = 0.0, 0.0

    for row in range(top - 2 * WINDOW_RADIUS, top):
        row_offset = np.uint64(row - top + 2 * WINDOW_RADIUS) * _ROW_FLOATS
        if row >= 0:
            _copy_row(image, row, first_float - 6 * WINDOW_RADIUS, padded_floats + 6 * WINDOW_RADIUS, buffer, _X_OFFSET)
            _copy_row(
                target, row, first_float - 6 * WINDOW_RADIUS, padded_floats + 6 * WINDOW_RADIUS, buffer, _Y_OFFSET
            )
            _moments_across(buffer, _MOMENTS_OFFSET + row_offset, padded_floats)

    # `base` is the first row of moments that this step blurs vertically; the gradient lags 5 rows behind.
    for base in range(top - WINDOW_RADIUS, bottom + WINDOW_RADIUS, _ROWS_PER_STEP):
        for step in range(_ROWS_PER_STEP):
            row = base + WINDOW_RADIUS + step
            row_offset = np.uint64(_CARRIED_ROWS + step) * _ROW_FLOATS
            if 0 <= row < height:
                _copy_row(
                    image, row, first_float - 6 * WINDOW_RADIUS, padded_floats + 6 * WINDOW_RADIUS, buffer, _X_OFFSET
                )
                _copy_row(
                    target, row, first_float - 6 * WINDOW_RADIUS, padded_floats + 6 * WINDOW_RADIUS, buffer, _Y_OFFSET
                )
                _moments_across(buffer, _MOMENTS_OFFSET + row_offset, padded_floats)
            else:
                for plane in range(4):
                    _clear(buffer, _MOMENTS_OFFSET + np.uint64(plane) * _PLANE_FLOATS + row_offset, padded_floats)

        for group in range(0, _ROWS_PER_STEP, _ROWS_PER_GROUP):
            for plane in range(4):
                source = _MOMENTS_OFFSET + np.uint64(plane) * _PLANE_FLOATS + np.uint64(group) * _ROW_FLOATS
                _blur_down(buffer, source, _BLURRED_OFFSET + np.uint64(plane) * _BLURRED_PLANE_FLOATS, padded_floats)
            for step in range(_ROWS_PER_GROUP):
                row = base + group + step
                row_offset = np.uint64(_CARRIED_ROWS + group + step) * _ROW_FLOATS
                if 0 <= row < height:
                    _compute_ssim_row(
                        buffer, _BLURRED_OFFSET + np.uint64(step) * _ROW_FLOATS, np.uint64(start), stop - start
                    )
                    if weighted:
                        for j in range(start, stop):
                            factor = weight[row, first_float - 3 * WINDOW_RADIUS + j]
                            j = np.uint64(j)
                            buffer[_SSIM_OFFSET + j] *= factor
                            buffer[_BY_X_OFFSET + j] *= factor
                            buffer[_BY_SQUARE_OFFSET + j] *= factor
                            buffer[_BY_PRODUCT_OFFSET + j] *= factor
                    if top <= row < bottom:
                        row_sum = np.float32(0)
                        for j in range(tile_floats):
                            row_sum += buffer[_SSIM_OFFSET + np.uint64(3 * WINDOW_RADIUS) + np.uint64(j)]
                        total_ssim += row_sum
                        if not needs_gradient:
                            total_l1 += _sum_differences(image, target, row, first_float, tile_floats)
                    if needs_gradient:
                        _blur_across(buffer, _BY_X_OFFSET, _DERIVATIVES_OFFSET + row_offset, padded_floats)
                        _blur_across(
                            buffer, _BY_SQUARE_OFFSET, _DERIVATIVES_OFFSET + _PLANE_FLOATS + row_offset, padded_floats
                        )
                        _blur_across(
                            buffer,
                            _BY_PRODUCT_OFFSET,
                            _DERIVATIVES_OFFSET + _U2 * _PLANE_FLOATS + row_offset,
                            padded_floats,
                        )
                else:
                    for plane in range(3):
                        _clear(
                            buffer, _DERIVATIVES_OFFSET + np.uint64(plane) * _PLANE_FLOATS + row_offset, padded_floats
                        )

        if needs_gradient:
            for group in range(0, _ROWS_PER_STEP, _ROWS_PER_GROUP):
                for plane in range(3):
                    source = _DERIVATIVES_OFFSET + np.uint64(plane) * _PLANE_FLOATS + np.uint64(group) * _ROW_FLOATS
                    _blur_down(
                        buffer, source, _BLURRED_OFFSET + np.uint64(plane) * _BLURRED_PLANE_FLOATS, padded_floats
                    )
                for step in range(_ROWS_PER_GROUP):
                    row = base - WINDOW_RADIUS + group + step
                    if top <= row < bottom:
                        row_offset = _BLURRED_OFFSET + np.uint64(step) * _ROW_FLOATS
                        row_sum = np.float32(0)
                        for j in range(tile_floats):
                            x, y = image[row, first_float + j], target[row, first_float + j]
                            i = row_offset + np.uint64(j)
                            by_x, by_square = buffer[i], buffer[i + _BLURRED_PLANE_FLOATS]
                            ssim_gradient = by_x + _TWO * x * by_square + y * buffer[i + _U2 * _BLURRED_PLANE_FLOATS]
                            row_sum += abs(x - y)
                            grad[row, first_float + j] = ssim_scale * ssim_gradient + l1_scale * np.sign(x - y)
                        total_l1 += row_sum
                        if weighted:
                            for j in range(tile_floats):
                                grad[row, first_float + j] *= weight[row, first_float + j]

        for plane in range(4):
            _carry_rows(buffer, _MOMENTS_OFFSET + np.uint64(plane) * _PLANE_FLOATS)
        for plane in range(3):
            _carry_rows(buffer, _DERIVATIVES_OFFSET + np.uint64(plane) * _PLANE_FLOATS)
    sums[0], sums[1] = total_l1, total_ssim


def loss_and_gradient(
    image: np.ndarray,
    target: np.ndarray,
    weight: np.ndarray | None,
    l1_weight: float,
    ssim_weight: float,
    needs_gradient: bool,
) -> tuple[float, np.ndarray]:
    """Compute the weighted sum of |image - target| and of 1 - SSIM over an image, and the gradient of `image`.

    Args:
        image, target: (H, 3W) float32, interleaved; equal where `weight` is 0.
        weight: (H, 3W) float32, 1 for values to include and 0 for others; None includes all.
        l1_weight, ssim_weight: factors of the two sums.
        needs_gradient: whether to compute the gradient, which takes a third of the time.

    Returns:
        The loss l1_weight * sum |x - y| + ssim_weight * sum (1 - SSIM), and its gradient (H, 3W) float32; without
        rows if it is not needed.
    """
    height, floats = image.shape
    width = floats // 3
    strips, tiles = -(-height // _MAX_TILE_ROWS), -(-width // _MAX_TILE_COLUMNS)
    gradient = np.empty((height if needs_gradient else 0, floats), np.float32)
    sums = np.zeros((strips * tiles, 2))
    count = image.size if weight is None else np.count_nonzero(weight)
    weights = np.empty((0, 0), np.float32) if weight is None else weight

    def task(index: int) -> None:
        strip, tile = divmod(index, tiles)
        top, bottom = height * strip // strips, height * (strip + 1) // strips
        left, right = width * tile // tiles, width * (tile + 1) // tiles
        scales = np.float32(l1_weight), np.float32(-ssim_weight)
        _process_tile(image, target, weights, *scales, top, bottom, left, right, gradient, sums[index])

    run_tasks(task, len(sums))
    l1, ssim = sums.sum(axis=0).tolist()
    return l1_weight * l1 + ssim_weight * (count - ssim), gradient

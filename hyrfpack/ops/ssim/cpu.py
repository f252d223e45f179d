"""L1 and SSIM with their gradient in one pass over the picture, in Numba.

A task walks down a tile of columns. Each row of the two pictures is read once and blurred across into the local
moments; 8 such rows with the 10 before them are blurred down, give SSIM and its derivatives by the moments, and those
are blurred across and down in the same way into the gradient (the window is symmetric, so its transpose is itself).
Pixels stay interleaved: a neighbour is 3 floats away. All rows of a task live in one buffer at constant places, which
lets the loops vectorise without alias checks, and stay in the second cache.
"""

from __future__ import annotations

import numba
import numpy as np

from hyrfpack.ops.ssim.reference import C1, C2, RADIUS, window
from hyrfpack.parallel.compiled import compiled
from hyrfpack.parallel.pool import run_tasks

# The error model of numpy: a division that tests for zero would keep its loop from vectorising.
_FAST_MATH = {"contract", "nsz", "nnan", "reassoc", "arcp"}
njit = compiled(fastmath=_FAST_MATH, error_model="numpy")
# Helpers leave no symbols behind: one that stays a call is found in its own object right after compiling and in its
# caller's when that comes from the cache, and the two may round differently.
inlined = numba.njit(fastmath=_FAST_MATH, error_model="numpy", forceinline=True)

_TILE, _STRIP = 236, 128  # most columns and rows of a task
_GROUP = 4  # rows blurred down together: they share most of what they load
_STEP = 2 * _GROUP
_KEPT = 2 * RADIUS

# Places in the buffer, in floats. A row starts at column -10 of the tile (x, y), -5 (moments) or 0 (gradient).
_ROW = np.uint64(3 * (_TILE + 4 * RADIUS) + 64)
_PLANE = _ROW * np.uint64(_KEPT + _STEP)
_X, _Y, _SSIM = np.uint64(0), _ROW, np.uint64(2) * _ROW
_BY_X, _BY_SQUARE, _BY_PRODUCT = np.uint64(3) * _ROW, np.uint64(4) * _ROW, np.uint64(5) * _ROW
_DOWN = np.uint64(6) * _ROW  # 4 planes of one group, blurred both ways
_DOWN_PLANE = np.uint64(_GROUP) * _ROW
_MOMENTS = _DOWN + np.uint64(4) * _DOWN_PLANE  # planes of x, y, xx + yy, xy, blurred across
_DERIVATIVES = _MOMENTS + np.uint64(4) * _PLANE  # planes of the derivatives by E[x], E[xx], E[xy], blurred across
_BUFFER = int(_DERIVATIVES + np.uint64(3) * _PLANE)

_U1, _U2, _U3 = np.uint64(1), np.uint64(2), np.uint64(3)
_W5, _W4, _W3, _W2, _W1, _W0 = (np.float32(weight) for weight in window()[: RADIUS + 1])
_C1, _C2, _TWO = np.float32(C1), np.float32(C2), np.float32(2)


@inlined
def _blur(a0, a1, a2, a3, a4, a5, a6, a7, a8, a9, a10):
    return _W0 * a5 + _W1 * (a4 + a6) + _W2 * (a3 + a7) + _W3 * (a2 + a8) + _W4 * (a1 + a9) + _W5 * (a0 + a10)


@inlined
def _blur_across(buffer, source, target, count):
    """Blur one row along its pixels."""
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
def _pair(buffer, i, k):
    """Sums of x, y, xx + yy and xy over the two pixels k floats either side of the window's middle."""
    left, right = i + np.uint64(15) - k, i + np.uint64(15) + k
    x0, x1, y0, y1 = buffer[_X + left], buffer[_X + right], buffer[_Y + left], buffer[_Y + right]
    return x0 + x1, y0 + y1, x0 * x0 + x1 * x1 + (y0 * y0 + y1 * y1), x0 * y0 + x1 * y1


@inlined
def _moments_across(buffer, target, count):
    """Blur x, y, xx + yy and xy of the row just read along its pixels."""
    for j in range(count):
        j = np.uint64(j)
        x, y = buffer[_X + j + np.uint64(15)], buffer[_Y + j + np.uint64(15)]
        x1, y1, s1, p1 = _pair(buffer, j, np.uint64(3))
        x2, y2, s2, p2 = _pair(buffer, j, np.uint64(6))
        x3, y3, s3, p3 = _pair(buffer, j, np.uint64(9))
        x4, y4, s4, p4 = _pair(buffer, j, np.uint64(12))
        x5, y5, s5, p5 = _pair(buffer, j, np.uint64(15))
        i = target + j
        buffer[i] = _W0 * x + _W1 * x1 + _W2 * x2 + _W3 * x3 + _W4 * x4 + _W5 * x5
        buffer[i + _PLANE] = _W0 * y + _W1 * y1 + _W2 * y2 + _W3 * y3 + _W4 * y4 + _W5 * y5
        square = _W0 * (x * x + y * y) + _W1 * s1 + _W2 * s2 + _W3 * s3 + _W4 * s4 + _W5 * s5
        buffer[i + _U2 * _PLANE] = square
        buffer[i + _U3 * _PLANE] = _W0 * (x * y) + _W1 * p1 + _W2 * p2 + _W3 * p3 + _W4 * p4 + _W5 * p5


@inlined
def _blur_down(buffer, source, target, count):
    """Blur 14 rows down into a group of 4."""
    for j in range(count):
        i, o = source + np.uint64(j), target + np.uint64(j)
        a0, a1 = buffer[i], buffer[i + _ROW]
        a2, a3 = buffer[i + np.uint64(2) * _ROW], buffer[i + np.uint64(3) * _ROW]
        a4, a5 = buffer[i + np.uint64(4) * _ROW], buffer[i + np.uint64(5) * _ROW]
        a6, a7 = buffer[i + np.uint64(6) * _ROW], buffer[i + np.uint64(7) * _ROW]
        a8, a9 = buffer[i + np.uint64(8) * _ROW], buffer[i + np.uint64(9) * _ROW]
        a10, a11 = buffer[i + np.uint64(10) * _ROW], buffer[i + np.uint64(11) * _ROW]
        a12, a13 = buffer[i + np.uint64(12) * _ROW], buffer[i + np.uint64(13) * _ROW]
        buffer[o] = _blur(a0, a1, a2, a3, a4, a5, a6, a7, a8, a9, a10)
        buffer[o + _ROW] = _blur(a1, a2, a3, a4, a5, a6, a7, a8, a9, a10, a11)
        buffer[o + _U2 * _ROW] = _blur(a2, a3, a4, a5, a6, a7, a8, a9, a10, a11, a12)
        buffer[o + _U3 * _ROW] = _blur(a3, a4, a5, a6, a7, a8, a9, a10, a11, a12, a13)


@inlined
def _derive(buffer, source, start, count):
    """SSIM and its derivatives by E[x], E[xx] and E[xy] along one row of moments."""
    for j in range(count):
        j = start + np.uint64(j)
        i = source + j
        x, y = buffer[i], buffer[i + _DOWN_PLANE]
        square, product = buffer[i + _U2 * _DOWN_PLANE], buffer[i + _U3 * _DOWN_PLANE]
        means = x * y
        energy = x * x + y * y
        a1, a2 = _TWO * means + _C1, _TWO * (product - means) + _C2
        b1, b2 = energy + _C1, square - energy + _C2
        scale = np.float32(1) / (b1 * b2)
        ssim = a1 * a2 * scale
        by_square, by_product = -ssim * b1 * scale, _TWO * a1 * scale
        buffer[_SSIM + j] = ssim
        buffer[_BY_SQUARE + j] = by_square
        buffer[_BY_PRODUCT + j] = by_product
        buffer[_BY_X + j] = y * (_TWO * a2 * scale - by_product) - _TWO * x * (ssim * b2 * scale + by_square)


@inlined
def _keep(buffer, plane):
    """Move the last rows of a plane to its start."""
    step = np.uint64(_STEP) * _ROW
    for j in range(np.uint64(_KEPT) * _ROW):
        buffer[plane + np.uint64(j)] = buffer[plane + step + np.uint64(j)]


@inlined
def _clear(buffer, target, count):
    for j in range(count):
        buffer[target + np.uint64(j)] = np.float32(0)


@inlined
def _read(pixels, row, start, count, buffer, target):
    """Copy `count` floats of a row from `start` on, with zeros outside the picture."""
    for j in range(count):
        i = start + j
        inside = 0 <= i < pixels.shape[1]
        buffer[target + np.uint64(j)] = pixels[row, i] if inside else np.float32(0)


@njit
def _tile(image, target, weight, l1_scale, ssim_scale, top, bottom, left, right, grad, sums):
    """Gradient and sums (of |x - y| and of SSIM) of the rows [top, bottom) and columns [left, right).

    `weight` counts each value 1 or 0; without rows it counts all.
    """
    buffer = np.zeros(_BUFFER, np.float32)
    height, floats = image.shape[0], image.shape[1]
    weighted = weight.shape[0] == height
    first = 3 * left
    inner = 3 * (right - left)
    middle = inner + 6 * RADIUS
    around = (middle + 31) // 32 * 32  # no remainders; the row has room
    # Part of a row of moments that has its middle in the picture.
    start, stop = max(0, 3 * RADIUS - first), min(middle, floats - first + 3 * RADIUS)
    total_l1, total_ssim = 0.0, 0.0

    for row in range(top - 2 * RADIUS, top):
        place = np.uint64(row - top + 2 * RADIUS) * _ROW
        if row >= 0:
            _read(image, row, first - 6 * RADIUS, around + 6 * RADIUS, buffer, _X)
            _read(target, row, first - 6 * RADIUS, around + 6 * RADIUS, buffer, _Y)
            _moments_across(buffer, _MOMENTS + place, around)

    # `base` is the first row of moments that this step blurs down; the gradient follows 5 rows behind.
    for base in range(top - RADIUS, bottom + RADIUS, _STEP):
        for step in range(_STEP):
            row = base + RADIUS + step
            place = np.uint64(_KEPT + step) * _ROW
            if 0 <= row < height:
                _read(image, row, first - 6 * RADIUS, around + 6 * RADIUS, buffer, _X)
                _read(target, row, first - 6 * RADIUS, around + 6 * RADIUS, buffer, _Y)
                _moments_across(buffer, _MOMENTS + place, around)
            else:
                for plane in range(4):
                    _clear(buffer, _MOMENTS + np.uint64(plane) * _PLANE + place, around)

        for group in range(0, _STEP, _GROUP):
            for plane in range(4):
                source = _MOMENTS + np.uint64(plane) * _PLANE + np.uint64(group) * _ROW
                _blur_down(buffer, source, _DOWN + np.uint64(plane) * _DOWN_PLANE, around)
            for step in range(_GROUP):
                row = base + group + step
                place = np.uint64(_KEPT + group + step) * _ROW
                if 0 <= row < height:
                    _derive(buffer, _DOWN + np.uint64(step) * _ROW, np.uint64(start), stop - start)
                    if weighted:
                        for j in range(start, stop):
                            factor = weight[row, first - 3 * RADIUS + j]
                            j = np.uint64(j)
                            buffer[_SSIM + j] *= factor
                            buffer[_BY_X + j] *= factor
                            buffer[_BY_SQUARE + j] *= factor
                            buffer[_BY_PRODUCT + j] *= factor
                    if top <= row < bottom:
                        part = np.float32(0)
                        for j in range(inner):
                            part += buffer[_SSIM + np.uint64(3 * RADIUS) + np.uint64(j)]
                        total_ssim += part
                    _blur_across(buffer, _BY_X, _DERIVATIVES + place, around)
                    _blur_across(buffer, _BY_SQUARE, _DERIVATIVES + _PLANE + place, around)
                    _blur_across(buffer, _BY_PRODUCT, _DERIVATIVES + _U2 * _PLANE + place, around)
                else:
                    for plane in range(3):
                        _clear(buffer, _DERIVATIVES + np.uint64(plane) * _PLANE + place, around)

        for group in range(0, _STEP, _GROUP):
            for plane in range(3):
                source = _DERIVATIVES + np.uint64(plane) * _PLANE + np.uint64(group) * _ROW
                _blur_down(buffer, source, _DOWN + np.uint64(plane) * _DOWN_PLANE, around)
            for step in range(_GROUP):
                row = base - RADIUS + group + step
                if top <= row < bottom:
                    place = _DOWN + np.uint64(step) * _ROW
                    part = np.float32(0)
                    for j in range(inner):
                        x, y = image[row, first + j], target[row, first + j]
                        i = place + np.uint64(j)
                        by_x, by_square = buffer[i], buffer[i + _DOWN_PLANE]
                        slope = by_x + _TWO * x * by_square + y * buffer[i + _U2 * _DOWN_PLANE]
                        part += abs(x - y)
                        grad[row, first + j] = ssim_scale * slope + l1_scale * np.sign(x - y)
                    total_l1 += part
                    if weighted:
                        for j in range(inner):
                            grad[row, first + j] *= weight[row, first + j]

        for plane in range(4):
            _keep(buffer, _MOMENTS + np.uint64(plane) * _PLANE)
        for plane in range(3):
            _keep(buffer, _DERIVATIVES + np.uint64(plane) * _PLANE)
    sums[0], sums[1] = total_l1, total_ssim


def loss_and_gradient(
    image: np.ndarray, target: np.ndarray, weight: np.ndarray | None, l1_weight: float, ssim_weight: float
) -> tuple[float, np.ndarray]:
    """Weighted sum of |image - target| and of 1 - SSIM over a picture, and its gradient by `image`.

    Args:
        image, target: (H, 3W) float32, interleaved; equal where `weight` is 0.
        weight: (H, 3W) float32, 1 where a value counts and 0 where not; None counts all.
        l1_weight, ssim_weight: what each value adds, as a factor.

    Returns:
        l1_weight * sum |x - y| + ssim_weight * sum (1 - SSIM), and (H, 3W) float32.
    """
    height, floats = image.shape
    width = floats // 3
    strips, tiles = -(-height // _STRIP), -(-width // _TILE)
    gradient = np.empty_like(image)
    sums = np.zeros((strips * tiles, 2))
    count = image.size if weight is None else np.count_nonzero(weight)
    weights = np.empty((0, 0), np.float32) if weight is None else weight

    def task(index: int) -> None:
        strip, tile = divmod(index, tiles)
        top, bottom = height * strip // strips, height * (strip + 1) // strips
        left, right = width * tile // tiles, width * (tile + 1) // tiles
        scales = np.float32(l1_weight), np.float32(-ssim_weight)
        _tile(image, target, weights, *scales, top, bottom, left, right, gradient, sums[index])

    run_tasks(task, len(sums))
    l1, ssim = sums.sum(axis=0).tolist()
    return l1_weight * l1 + ssim_weight * (count - ssim), gradient

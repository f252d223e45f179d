"""Compiled code that compares photos on planes at many depths."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hyrfpack.parallel.compiled import compiled
from hyrfpack.parallel.pool import run_ranges

WINDOW_RADIUS = 3
# Added to each variance of a window, so that windows without texture correlate with nothing.
NOISE_VARIANCE = (2 / 255) ** 2
_MIN_PLANES_PER_RANGE = 8
UNSEEN_COST = np.float32(2.0)  # Cost where the other photo does not show the pixel's point.
_kernel = compiled(fastmath={"contract", "nsz"}, error_model="numpy")


@_kernel
def _window_means(values, rows, out):
    """Write the means of `values` (H, W) over square windows to `out`; windows end at the border.

    Args:
        rows: (H, W) scratch memory.
    """
    height, width = values.shape
    r = WINDOW_RADIUS
    inner = max(0, width - 2 * r)
    for y in range(height):
        for x in range(min(r, width)):
            total = np.float32(0)
            for i in range(min(width, x + r + 1)):
                total += values[y, i]
            rows[y, x] = total / np.float32(min(width, x + r + 1))
        line, sums = values[y], rows[y, r:]
        for x in range(inner):
            total = np.float32(0)
            for i in range(2 * WINDOW_RADIUS + 1):
                total += line[np.uint64(x) + np.uint64(i)]
            sums[np.uint64(x)] = total / np.float32(2 * WINDOW_RADIUS + 1)
        for x in range(max(r, width - r), width):
            total = np.float32(0)
            for i in range(x - r, width):
                total += values[y, i]
            rows[y, x] = total / np.float32(width - (x - r))
    for y in range(height):
        low, high = max(0, y - r), min(height, y + r + 1)
        sums, share = out[y], np.float32(1 / (high - low))
        if high - low == 2 * WINDOW_RADIUS + 1:
            for x in range(width):
                total = np.float32(0)
                for i in range(2 * WINDOW_RADIUS + 1):
                    total += rows[np.uint64(low) + np.uint64(i), np.uint64(x)]
                sums[x] = total * share
        else:
            for x in range(width):
                total = np.float32(0)
                for i in range(low, high):
                    total += rows[i, x]
                sums[x] = total * share


@_kernel
def _warp_row(y, other, size, homography, offset, index, right, down, seen, warped):
    """Write the grey values of another photo at the points that row y of a photo shows on a plane to warped (W,).

    Args:
        other, size: (H2 + 1, W2 + 1) float32, grey values of the other photo, whose height and width are `size`. What
            lies beyond them is finite and does not count.
        homography, offset: 3 x 3 and 3, float64, see `compare_on_planes`; the offset is that of the plane.
        index, right, down: (W,) uint64 and float32, scratch memory.
        seen: (W,) bool, where the other photo shows the point.
    """
    stride = np.uint64(other.shape[1])
    last_row, last_column = float(size[0] - 1), float(size[1] - 1)
    h, py = homography, y + 0.5
    ox, oy, oz = offset[0], offset[1], offset[2]
    for x in range(len(warped)):
        px = x + 0.5
        w = h[2][0] * px + h[2][1] * py + h[2][2] + oz
        front = w > 1e-9
        w = w if front else 1.0
        u = (h[0][0] * px + h[0][1] * py + h[0][2] + ox) / w - 0.5
        v = (h[1][0] * px + h[1][1] * py + h[1][2] + oy) / w - 0.5
        seen[x] = front & (u >= 0) & (u <= last_column) & (v >= 0) & (v <= last_row)
        u = min(u, last_column) if u > 0 else 0.0  # 0 for NaN, too
        v = min(v, last_row) if v > 0 else 0.0
        left, top = np.int32(u), np.int32(v)
        right[x], down[x] = np.float32(u - left), np.float32(v - top)
        index[x] = np.uint64(top) * stride + np.uint64(left)
    values = other.ravel()
    for x in range(len(warped)):
        at = index[x]
        below = at + stride
        upper = values[at] + right[x] * (values[at + np.uint64(1)] - values[at])
        lower = values[below] + right[x] * (values[below + np.uint64(1)] - values[below])
        warped[x] = upper + down[x] * (lower - upper)


@_kernel
def _compare(start, stop, photo, mean, variance, others, sizes, homographies, offsets, inverse_depths, volume):
    """Write the costs of planes start to stop to volume[..., start:stop], see `compare_on_planes`.

    Args:
        photo, mean, variance: (H, W) float32: grey values, and their means and variances over windows.
        others, sizes: (S, H2 + 1, W2 + 1) float32, grey values of the other photos, filled up to one size, and their
            heights and widths (S, 2).
        homographies, offsets, inverse_depths: as in `compare_on_planes`.
        volume: (H, W, P) float32.
    """
    height, width = photo.shape
    warped = np.empty((height, width), np.float32)
    product = np.empty((height, width), np.float32)
    square = np.empty((height, width), np.float32)
    scratch = np.empty((height, width), np.float32)
    warped_mean = np.empty((height, width), np.float32)
    square_mean = np.empty((height, width), np.float32)
    product_mean = np.empty((height, width), np.float32)
    seen = np.empty((height, width), np.bool_)
    index = np.empty(width, np.uint64)
    right, down = np.empty(width, np.float32), np.empty(width, np.float32)
    costs = np.empty((len(others), height, width), np.float32)
    for plane in range(start, stop):
        for source in range(len(others)):
            offset = offsets[source] * inverse_depths[plane]
            for y in range(height):
                row = warped[y]
                _warp_row(
                    y, others[source], sizes[source], homographies[source], offset, index, right, down, seen[y], row
                )
                for x in range(width):
                    product[y, x] = row[x] * photo[y, x]
                    square[y, x] = row[x] * row[x]
            _window_means(warped, scratch, warped_mean)
            _window_means(product, scratch, product_mean)
            _window_means(square, scratch, square_mean)
            for y in range(height):
                for x in range(width):
                    m = warped_mean[y, x]
                    spread = max(square_mean[y, x] - m * m, np.float32(0)) + np.float32(NOISE_VARIANCE)
                    covariance = product_mean[y, x] - m * mean[y, x]
                    deviation = np.sqrt(spread * (variance[y, x] + np.float32(NOISE_VARIANCE)))
                    cost = np.float32(1) - min(max(covariance / deviation, np.float32(0)), np.float32(1))
                    costs[source, y, x] = cost if seen[y, x] else UNSEEN_COST
        _combine(costs, volume[:, :, plane])


@_kernel
def _combine(costs, combined):
    """Write the mean cost of the better half of the photos that show a pixel's point to combined (H, W).

    Args:
        costs: (S, H, W) float32, `UNSEEN_COST` where a photo does not show the point.
        combined: (H, W) float32, 1 where no photo does.
    """
    count, height, width = costs.shape
    ordered = np.empty(count, np.float32)
    for y in range(height):
        for x in range(width):
            seen = 0
            for source in range(count):
                cost = costs[source, y, x]
                if cost == UNSEEN_COST:
                    continue
                at = seen
                while at > 0 and ordered[at - 1] > cost:
                    ordered[at] = ordered[at - 1]
                    at -= 1
                ordered[at] = cost
                seen += 1
            used = (seen + 1) // 2
            total = np.float32(0)
            for i in range(used):
                total += ordered[i]
            combined[y, x] = total / np.float32(used) if used else np.float32(1)


def window_means(values: np.ndarray) -> np.ndarray:
    """Return the means of values (H, W) float32 over square windows, which end at the border."""
    means = np.empty_like(values)
    _window_means(values, np.empty_like(values), means)
    return means


def compare_on_planes(
    photo: np.ndarray,
    others: Sequence[np.ndarray],
    homographies: np.ndarray,
    offsets: np.ndarray,
    inverse_depths: np.ndarray,
) -> np.ndarray:
    """Compare a photo with S others on P planes.

    Args:
        photo: (H, W) float32, grey values in [0, 1].
        others: grey values of the other photos, which may have other sizes.
        homographies, offsets: (S, 3, 3) and (S, 3) float64: the pixel (x, y) at depth z lies in the other photo at the
            first two numbers of homography (x, y, 1) + offset / z, divided by the third one.
        inverse_depths: (P,) float64, 1 / z of the planes.

    Returns:
        Costs (H, W, P) float32: the mean of 1 - max(0, correlation) over the better half of the other photos that show
        the pixel's point; 1 where none does.
    """
    mean = window_means(photo)
    variance = np.maximum(window_means(photo * photo) - mean * mean, 0)
    sizes = np.array([other.shape for other in others])
    filled = np.zeros((len(others), *(sizes.max(0) + 1)), np.float32)
    for row, other in zip(filled, others, strict=True):
        row[: other.shape[0], : other.shape[1]] = other
    volume = np.empty((*photo.shape, len(inverse_depths)), np.float32)

    def task(start: int, stop: int) -> None:
        _compare(start, stop, photo, mean, variance, filled, sizes, homographies, offsets, inverse_depths, volume)

    run_ranges(task, len(inverse_depths), _MIN_PLANES_PER_RANGE)
    return volume

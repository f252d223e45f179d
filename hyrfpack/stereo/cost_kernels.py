"""Compiled code that compares photos on planes at many depths."""

from __future__ import annotations

import math

import numpy as np

from hyrfpack.parallel.compiled import compiled
from hyrfpack.parallel.pool import run_ranges

WINDOW_RADIUS = 3
# Added to each variance of a window, so that windows without texture correlate with nothing.
NOISE_VARIANCE = (2 / 255) ** 2
_MIN_PLANES_PER_RANGE = 8
_MIN_ROWS_PER_RANGE = 16
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
    for y in range(height):
        for x in range(min(r, width)):
            total = np.float32(0)
            for i in range(min(width, x + r + 1)):
                total += values[y, i]
            rows[y, x] = total / np.float32(min(width, x + r + 1))
        for x in range(r, width - r):
            total = np.float32(0)
            for i in range(-r, r + 1):
                total += values[y, x + i]
            rows[y, x] = total / np.float32(2 * r + 1)
        for x in range(max(r, width - r), width):
            total = np.float32(0)
            for i in range(x - r, width):
                total += values[y, i]
            rows[y, x] = total / np.float32(width - (x - r))
    for y in range(height):
        low, high = max(0, y - r), min(height, y + r + 1)
        out[y] = 0
        for i in range(low, high):
            for x in range(width):
                out[y, x] += rows[i, x]
        share = np.float32(1 / (high - low))
        for x in range(width):
            out[y, x] *= share


@_kernel
def _compare(start, stop, photo, mean, variance, other, homography, offset, inverse_depths, costs):
    """Write the costs of planes start to stop, 1 - max(0, correlation) of windows, to costs[start:stop].

    Args:
        photo, mean, variance: (H, W) float32: grey values, and their means and variances over windows.
        other: (H2, W2) float32, grey values of the other photo.
        homography, offset: 3 x 3 and 3, float64: the pixel (x, y) at depth z lies in the other photo at the first two
            numbers of homography (x, y, 1) + offset / z, divided by the third one.
        inverse_depths: (P,) float64, 1 / z of the planes.
        costs: (P, H, W) float32.
    """
    height, width = photo.shape
    other_height, other_width = other.shape
    warped = np.empty((height, width), np.float32)
    product = np.empty((height, width), np.float32)
    scratch = np.empty((height, width), np.float32)
    warped_mean = np.empty((height, width), np.float32)
    square_mean = np.empty((height, width), np.float32)
    product_mean = np.empty((height, width), np.float32)
    seen = np.empty((height, width), np.bool_)
    h = homography
    for plane in range(start, stop):
        inverse_depth = inverse_depths[plane]
        ox, oy, oz = offset[0] * inverse_depth, offset[1] * inverse_depth, offset[2] * inverse_depth
        for y in range(height):
            for x in range(width):
                px, py = x + 0.5, y + 0.5
                w = h[2][0] * px + h[2][1] * py + h[2][2] + oz
                front = w > 1e-9
                w = w if front else 1.0
                u = (h[0][0] * px + h[0][1] * py + h[0][2] + ox) / w
                v = (h[1][0] * px + h[1][1] * py + h[1][2] + oy) / w
                seen[y, x] = front and 0.5 <= u <= other_width - 0.5 and 0.5 <= v <= other_height - 0.5
                u = min(u - 0.5, other_width - 1.0) if u > 0.5 else 0.0  # 0 for NaN, too
                v = min(v - 0.5, other_height - 1.0) if v > 0.5 else 0.0
                left, top = int(u), int(v)
                right, bottom = min(left + 1, other_width - 1), min(top + 1, other_height - 1)
                a, b = np.float32(u - left), np.float32(v - top)
                upper = other[top, left] + a * (other[top, right] - other[top, left])
                lower = other[bottom, left] + a * (other[bottom, right] - other[bottom, left])
                warped[y, x] = upper + b * (lower - upper)
        for y in range(height):
            for x in range(width):
                product[y, x] = warped[y, x] * photo[y, x]
        _window_means(warped, scratch, warped_mean)
        _window_means(product, scratch, product_mean)
        for y in range(height):
            for x in range(width):
                product[y, x] = warped[y, x] * warped[y, x]
        _window_means(product, scratch, square_mean)
        for y in range(height):
            for x in range(width):
                m = warped_mean[y, x]
                spread = max(square_mean[y, x] - m * m, np.float32(0)) + np.float32(NOISE_VARIANCE)
                covariance = product_mean[y, x] - m * mean[y, x]
                correlation = covariance / math.sqrt(spread * (variance[y, x] + np.float32(NOISE_VARIANCE)))
                cost = np.float32(1) - min(max(correlation, np.float32(0)), np.float32(1))
                costs[plane, y, x] = cost if seen[y, x] else UNSEEN_COST


@_kernel
def _combine(start, stop, costs, combined):
    """Write the mean cost of the better half of the photos that show a pixel's point to combined[start:stop].

    Args:
        costs: (S, P, H, W) float32, `UNSEEN_COST` where a photo does not show the point.
        combined: (H, W, P) float32, 1 where no photo does.
    """
    count, planes, _, width = costs.shape
    ordered = np.empty(count, np.float32)
    for y in range(start, stop):
        for x in range(width):
            for plane in range(planes):
                seen = 0
                for source in range(count):
                    cost = costs[source, plane, y, x]
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
                combined[y, x, plane] = total / np.float32(used) if used else np.float32(1)


def window_means(values: np.ndarray) -> np.ndarray:
    """Return the means of values (H, W) float32 over square windows, which end at the border."""
    means = np.empty_like(values)
    _window_means(values, np.empty_like(values), means)
    return means


def compare_on_planes(
    photo: np.ndarray,
    mean: np.ndarray,
    variance: np.ndarray,
    other: np.ndarray,
    homography: np.ndarray,
    offset: np.ndarray,
    inverse_depths: np.ndarray,
) -> np.ndarray:
    """Return the costs (P, H, W) float32 of a photo's pixels on planes; arguments as in `_compare`."""
    costs = np.empty((len(inverse_depths), *photo.shape), np.float32)

    def task(start: int, stop: int) -> None:
        _compare(start, stop, photo, mean, variance, other, homography, offset, inverse_depths, costs)

    run_ranges(task, len(inverse_depths), _MIN_PLANES_PER_RANGE)
    return costs


def combine_costs(costs: np.ndarray) -> np.ndarray:
    """Combine the costs (S, P, H, W) of S photos to (H, W, P), see `_combine`."""
    _, planes, height, width = costs.shape
    combined = np.empty((height, width, planes), np.float32)
    run_ranges(lambda start, stop: _combine(start, stop, costs, combined), height, _MIN_ROWS_PER_RANGE)
    return combined

"""Smooth the costs of depths along lines of a photo (semi-global matching)."""

from __future__ import annotations

import numpy as np

from hyrfpack.parallel.compiled import compiled
from hyrfpack.parallel.pool import run_ranges

# Penalty on a depth that differs by one plane from that of the neighbouring pixel (P1), and by more (P2).
SMALL_JUMP_PENALTY = 0.2
LARGE_JUMP_PENALTY = 1.2
# The penalty on large jumps is half as high where neighbours differ by this in grey value. It is at least
# MIN_PENALTY_RATIO times that on small jumps.
EDGE_CONTRAST = 0.04
MIN_PENALTY_RATIO = 1.5
# Steps from one pixel of a path to the next: rows down, columns right.
PATH_STEPS = ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (-1, -1), (1, -1), (-1, 1))
_MIN_LINES_PER_RANGE = 16
_kernel = compiled(fastmath={"contract", "nsz"}, error_model="numpy")


@_kernel
def _add_lines(start, stop, starts, dy, dx, costs, photo, small, large, total):
    """Add the path costs of lines start to stop to `total`.

    Args:
        starts: (L, 2) int64, row and column of each line's first pixel.
        dy, dx: the step from one pixel of a line to the next.
        costs: (H, W, P) float32.
        photo: (H, W) float32, grey values.
        small, large: see SMALL_JUMP_PENALTY and LARGE_JUMP_PENALTY; float32.
        total: (H, W, P) float32.
    """
    height, width, planes = costs.shape
    path = np.empty(planes, np.float32)
    previous = np.empty(planes, np.float32)
    for line in range(start, stop):
        y, x = starts[line]
        for p in range(planes):
            path[p] = costs[y, x, p]
            total[y, x, p] += path[p]
        grey = photo[y, x]
        y += dy
        x += dx
        while 0 <= y < height and 0 <= x < width:
            lowest = path[0]
            for p in range(planes):
                previous[p] = path[p]
                lowest = min(lowest, path[p])
            contrast = abs(photo[y, x] - grey) / np.float32(EDGE_CONTRAST)
            jump = lowest + max(large / (np.float32(1) + contrast), np.float32(MIN_PENALTY_RATIO) * small)
            for p in range(1, planes - 1):
                best = min(min(previous[p], jump), min(previous[p - 1], previous[p + 1]) + small)
                path[p] = costs[y, x, p] + best - lowest
            best = min(min(previous[0], jump), previous[1] + small)
            path[0] = costs[y, x, 0] + best - lowest
            best = min(min(previous[planes - 1], jump), previous[planes - 2] + small)
            path[planes - 1] = costs[y, x, planes - 1] + best - lowest
            for p in range(planes):
                total[y, x, p] += path[p]
            grey = photo[y, x]
            y += dy
            x += dx


def aggregate_costs(costs: np.ndarray, photo: np.ndarray) -> np.ndarray:
    """Sum the costs of the cheapest paths that end in each pixel and plane, from eight directions.

    A path's cost is that of its pixels, plus SMALL_JUMP_PENALTY or LARGE_JUMP_PENALTY where its depth changes
    (Hirschmueller, "Stereo Processing by Semiglobal Matching and Mutual Information", 2008).

    Args:
        costs: (H, W, P) float32, finite; P is at least 2.
        photo: (H, W) float32, grey values in [0, 1]; jumps cost less at its edges.

    Returns:
        (H, W, P) float32. The smallest sum of a pixel marks its depth.
    """
    total = np.zeros_like(costs)
    for dy, dx in PATH_STEPS:
        _add_paths(dy, dx, costs, photo, total)
    return total


def _add_paths(dy: int, dx: int, costs: np.ndarray, photo: np.ndarray, total: np.ndarray) -> None:
    """Add the path costs of one direction to `total`."""
    height, width, _ = costs.shape
    rows, columns = np.mgrid[:height, :width].reshape(2, -1)
    is_first = np.zeros(height * width, bool)
    if dy:
        is_first |= rows == (0 if dy > 0 else height - 1)
    if dx:
        is_first |= columns == (0 if dx > 0 else width - 1)
    starts = np.stack([rows, columns], 1)[is_first]
    penalties = np.float32(SMALL_JUMP_PENALTY), np.float32(LARGE_JUMP_PENALTY)

    def task(start: int, stop: int) -> None:
        _add_lines(start, stop, starts, dy, dx, costs, photo, *penalties, total)

    run_ranges(task, len(starts), _MIN_LINES_PER_RANGE)

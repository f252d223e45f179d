"""Smooth the costs of depths along lines of a photo (semi-global matching)."""

from __future__ import annotations

import numpy as np

from hyrfpack.parallel.compiled import compiled
from hyrfpack.parallel.pool import run_ranges

# Cost of a depth that differs by one plane from that of the neighbouring pixel, and by more.
STEP_COST = 0.2
JUMP_COST = 1.2
# Jumps cost half as much where neighbours differ by this in grey value.
EDGE_CONTRAST = 0.04
MIN_JUMP_RATIO = 1.5  # of the cost of a jump to that of a step
DIRECTIONS = ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (-1, -1), (1, -1), (-1, 1))
_MIN_LINES_PER_RANGE = 16
_kernel = compiled(fastmath={"contract", "nsz"}, error_model="numpy")


@_kernel
def _add_lines(start, stop, starts, dy, dx, costs, photo, step_cost, jump_cost, total):
    """Add the path costs of lines start to stop to `total`.

    Args:
        starts: (L, 2) int64, row and column of each line's first pixel.
        dy, dx: the step from one pixel of a line to the next.
        costs: (H, W, P) float32.
        photo: (H, W) float32, grey values.
        step_cost, jump_cost: see STEP_COST and JUMP_COST; float32.
        total: (H, W, P) float32.
    """
    height, width, planes = costs.shape
    path = np.empty(planes, np.float32)
    before = np.empty(planes, np.float32)
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
                before[p] = path[p]
                lowest = min(lowest, path[p])
            contrast = abs(photo[y, x] - grey) / np.float32(EDGE_CONTRAST)
            jump = lowest + max(jump_cost / (np.float32(1) + contrast), np.float32(MIN_JUMP_RATIO) * step_cost)
            for p in range(1, planes - 1):
                best = min(min(before[p], jump), min(before[p - 1], before[p + 1]) + step_cost)
                path[p] = costs[y, x, p] + best - lowest
            best = min(min(before[0], jump), before[1] + step_cost)
            path[0] = costs[y, x, 0] + best - lowest
            best = min(min(before[planes - 1], jump), before[planes - 2] + step_cost)
            path[planes - 1] = costs[y, x, planes - 1] + best - lowest
            for p in range(planes):
                total[y, x, p] += path[p]
            grey = photo[y, x]
            y += dy
            x += dx


def aggregate_costs(costs: np.ndarray, photo: np.ndarray) -> np.ndarray:
    """Sum the costs of the cheapest paths that end in each pixel and plane, from eight directions.

    A path's cost is that of its pixels, plus STEP_COST or JUMP_COST where its depth changes (Hirschmueller,
    "Stereo Processing by Semiglobal Matching and Mutual Information", 2008).

    Args:
        costs: (H, W, P) float32, finite; P is at least 2.
        photo: (H, W) float32, grey values in [0, 1]; jumps cost less at its edges.

    Returns:
        (H, W, P) float32. The smallest sum of a pixel marks its depth.
    """
    total = np.zeros_like(costs)
    for dy, dx in DIRECTIONS:
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

    def task(start: int, stop: int) -> None:
        _add_lines(start, stop, starts, dy, dx, costs, photo, np.float32(STEP_COST), np.float32(JUMP_COST), total)

    run_ranges(task, len(starts), _MIN_LINES_PER_RANGE)

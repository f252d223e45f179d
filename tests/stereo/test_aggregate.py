"""hyrfpack.stereo.aggregate: path costs against a plain float64 implementation, and what they smooth."""

from __future__ import annotations

import numpy as np
import pytest

from hyrfpack.stereo.aggregate import (
    EDGE_CONTRAST,
    LARGE_JUMP_PENALTY,
    MIN_PENALTY_RATIO,
    PATH_STEPS,
    SMALL_JUMP_PENALTY,
    aggregate_costs,
)


def reference(costs: np.ndarray, photo: np.ndarray) -> np.ndarray:
    """Compute `aggregate_costs` pixel by pixel in float64, from its definition."""
    costs, photo = costs.astype(np.float64), photo.astype(np.float64)
    height, width, planes = costs.shape
    jumps = np.abs(np.subtract.outer(np.arange(planes), np.arange(planes)))
    total = np.zeros_like(costs)
    for dy, dx in PATH_STEPS:
        path = np.zeros_like(costs)
        for y in range(height)[:: 1 if dy >= 0 else -1]:
            for x in range(width)[:: 1 if dx >= 0 else -1]:
                path[y, x] = costs[y, x]
                if 0 <= y - dy < height and 0 <= x - dx < width:
                    before = path[y - dy, x - dx]
                    contrast = abs(photo[y, x] - photo[y - dy, x - dx]) / EDGE_CONTRAST
                    jump = max(LARGE_JUMP_PENALTY / (1 + contrast), MIN_PENALTY_RATIO * SMALL_JUMP_PENALTY)
                    change = np.where(jumps == 0, 0, np.where(jumps == 1, min(SMALL_JUMP_PENALTY, jump), jump))
                    path[y, x] += (before[None] + change).min(1) - before.min()
        total += path
    return total


@pytest.mark.parametrize("shape", [(9, 12, 6), (1, 7, 5), (7, 1, 3), (1, 1, 4), (4, 5, 2)], ids=str)
def test_sums_are_those_of_the_reference(shape):
    generator = np.random.default_rng(0)
    costs = generator.random(shape, np.float32)
    photo = generator.choice([0.2, 0.25, 0.9], shape[:2]).astype(np.float32)
    np.testing.assert_allclose(aggregate_costs(costs, photo), reference(costs, photo), rtol=1e-5)


def test_pixels_without_evidence_take_the_depth_around_them():
    costs = np.full((15, 15, 8), 0.9, np.float32)
    costs[..., 5] = 0.1
    costs[5:10, 5:10] = 1.0
    depth = aggregate_costs(costs, np.full((15, 15), 0.5, np.float32)).argmin(-1)
    assert (depth == 5).all()


def test_depths_jump_at_an_edge_of_the_photo():
    """Unclear pixels between two depths take the one of their side of the edge."""
    costs = np.full((12, 20, 16), 0.9, np.float32)
    costs[:, :6, 3], costs[:, 14:, 12] = 0.1, 0.1
    photo = np.full((12, 20), 0.2, np.float32)
    photo[:, 12:] = 0.8
    depth = aggregate_costs(costs, photo).argmin(-1)
    assert (depth[:, :12] == 3).all() and (depth[:, 12:] == 12).all()

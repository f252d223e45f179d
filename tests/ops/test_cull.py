from __future__ import annotations

import numpy as np
import pytest
import torch
from scenes import look_at

from hyrfpack.ops.rasterize.cull import frustum_cull

WIDTH, HEIGHT, INTRINSICS = 64, 40, (50.0, 60.0, 20.0, 25.0)


def cull(points, pose, *, near=0.01, tolerance=0.3) -> torch.Tensor:
    positions = torch.as_tensor(np.asarray(points), dtype=torch.float32).reshape(-1, 3)
    return frustum_cull(positions, torch.from_numpy(pose).float(), INTRINSICS, WIDTH, HEIGHT, near, tolerance)


@pytest.mark.parametrize("tolerance", [0.0, 0.3, 2.0])
@pytest.mark.parametrize("near", [0.01, 1.0])
def test_cull_keeps_what_projects_into_the_widened_picture(near, tolerance):
    pose = look_at((1.0, -2.0, 0.5), (0.0, 0.0, 0.0))
    points = np.random.default_rng(0).normal(size=(5000, 3)) * 3
    fx, fy, cx, cy = INTRINSICS
    kept, undecided = set(), set()
    for i, point in enumerate(points):
        x, y, z = pose[:3, :3] @ point + pose[:3, 3]
        if abs(z - near) < 1e-4:
            undecided.add(i)
        elif z > near:
            # Distances from the picture's middle in units of half its size: inside is [-1, 1].
            across = (fx * x / z + cx - WIDTH / 2) / (WIDTH / 2)
            down = (fy * y / z + cy - HEIGHT / 2) / (HEIGHT / 2)
            excess = max(abs(across), abs(down)) - (1 + tolerance)
            if abs(excess) < 1e-4:
                undecided.add(i)
            elif excess < 0:
                kept.add(i)

    index = cull(points, pose, near=near, tolerance=tolerance)

    assert len(kept) > 100 and len(undecided) < 20
    assert set(index.tolist()) - undecided == kept - undecided


def test_cull_returns_ascending_int64():
    index = cull(np.random.default_rng(1).normal(size=(500, 3)), look_at((0, -3, 0), (0, 0, 0)))
    assert index.dtype == torch.int64 and (index.diff() > 0).all()


def test_cull_drops_points_at_the_camera_and_behind_it():
    pose = look_at((0.0, -3.0, 0.0), (0.0, 0.0, 0.0))
    assert cull([[0, -3, 0], [0, -4, 0], [0, -1e6, 0], [0, -2, 0]], pose).tolist() == [3]


def test_cull_drops_points_that_are_not_finite():
    pose = look_at((0.0, -3.0, 0.0), (0.0, 0.0, 0.0))
    bad = [[np.nan, 0, 0], [0, np.nan, 0], [0, 0, np.nan], [np.inf, 0, 0], [0, np.inf, 0], [0, 0, 0]]
    assert cull(bad, pose).tolist() == [5]


def test_cull_of_no_points_is_empty():
    assert cull(np.zeros((0, 3)), np.eye(4)).shape == (0,)

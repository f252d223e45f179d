"""Similarities of world positions."""

from __future__ import annotations

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scenes import ball_scene

from hyrfpack.cameras.placement import Placement

TURN_MATRIX = Placement.rotation_about_axis((0.3, -1.0, 0.4), 130).rotation
TEST_PLACEMENT = Placement(2.5, TURN_MATRIX, np.array([3.0, -2.0, 0.5]))


def test_a_moved_scene_shows_its_points_at_the_same_pixels():
    scene = ball_scene(points=20)
    moved = TEST_PLACEMENT.move_scene(scene)
    assert moved.train[0].name == scene.train[0].name and len(moved.test) == len(scene.test)
    for before, after in zip(scene.views, moved.views, strict=True):
        local, moved_local = (
            points @ view.camera.camera_from_world[:3, :3].T + view.camera.camera_from_world[:3, 3]
            for view, points in ((before, scene.points), (after, moved.points))
        )
        assert_allclose(moved_local, TEST_PLACEMENT.factor * local, atol=1e-9)


def test_stored_placements_are_read_back_to_nine_digits():
    read = Placement.from_json(json.loads(json.dumps(TEST_PLACEMENT.to_json())))
    assert read.factor == TEST_PLACEMENT.factor
    assert_allclose(read.rotation, TEST_PLACEMENT.rotation, atol=1e-8)
    assert_allclose(read.offset, TEST_PLACEMENT.offset, rtol=1e-8)
    assert Placement.from_json(Placement().to_json()).is_identity


@pytest.mark.parametrize(
    "change",
    [
        {"factor": 0},
        {"factor": float("inf")},
        {"factor": "two"},
        {"offset": [1, 2]},
        {"offset": [1, 2, float("nan")]},
        {"rotation": [1, 1, 0, 0]},
        {"rotation": None},
    ],
    ids=str,
)
def test_invalid_placements_are_refused(change):
    with pytest.raises((TypeError, ValueError)):
        Placement.from_json({**TEST_PLACEMENT.to_json(), **change})

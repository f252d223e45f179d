from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from explicit_balls import ball_splats

from hyrfpack.splats import viewpoints as views
from hyrfpack.splats.draw import Drawable
from hyrfpack.splats.splats import Splats, concatenate
from hyrfpack.splats.viewpoints import (
    MAX_CLUTTER,
    MIN_COVERAGE,
    OUTSIDE_DISTANCE_RANGE_RADII,
    WeightedSplats,
    coverage,
    sample_viewpoints,
)


def seen(splats: Splats, count: int = 12, seed: int = 0):
    weighted = WeightedSplats.from_splats(splats, "x")
    drawable = Drawable.from_splats(splats, weighted.frame)
    return weighted, drawable, sample_viewpoints(weighted, drawable, count, 32, seed)


def solid_ball() -> Splats:
    """Splats all through the unit ball."""
    splats, depths = ball_splats(400), np.random.default_rng(1).random((400, 1)) ** (1 / 3)
    return replace(splats, positions=splats.positions * depths)


def room() -> Splats:
    """Large splats on a sphere of radius 5 that is empty inside."""
    splats = ball_splats(600)
    return replace(splats, positions=5 * splats.positions, scales=np.full((600, 3), 0.5), opacities=np.full(600, 0.9))


def test_objects_are_seen_from_outside_and_rooms_from_inside() -> None:
    weighted, _, outside = seen(solid_ball())
    assert all(np.linalg.norm(camera.position) > 0.9 for camera in outside)
    _, _, inside = seen(room())
    assert all(np.linalg.norm(camera.position) < 5 for camera in inside)


def test_views_show_something_and_stand_clear() -> None:
    weighted, drawable, cameras = seen(solid_ball())
    assert min(coverage(drawable, camera) for camera in cameras) >= MIN_COVERAGE
    assert max(weighted.clutter(camera.position) for camera in cameras) <= MAX_CLUTTER
    reach = weighted.radius * OUTSIDE_DISTANCE_RANGE_RADII[1] + 1
    assert max(np.linalg.norm(camera.position) for camera in cameras) <= reach


def test_another_seed_gives_other_views_and_the_same_seed_the_same() -> None:
    first, again, other = (
        np.array([camera.position for camera in seen(solid_ball(), seed=seed)[2]]) for seed in (0, 0, 1)
    )
    assert np.array_equal(first, again)
    assert np.abs(first - other).max(1).min() > 0.01


def test_far_away_splat_does_not_stretch_the_frame() -> None:
    splats = solid_ball()
    positions = splats.positions.copy()
    positions[0] = 1e5
    assert WeightedSplats.from_splats(replace(splats, positions=positions), "x").frame.scale < 2


def test_sky_does_not_stretch_the_frame() -> None:
    ground, sky = solid_ball(), room()
    sky = replace(sky, positions=100 * sky.positions, scales=100 * sky.scales)
    weighted, drawable, cameras = seen(concatenate((replace(ground, scales=ground.scales / 2), sky[::10])))
    assert weighted.frame.scale < 2
    assert np.abs([camera.position for camera in cameras]).max() < 10


def test_of_many_splats_some_tell_what_a_place_is_like(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each fourth, as if there were four of it: where many lie behind each other, that is nearly what all say."""
    ball_splats = solid_ball()
    faint = replace(ball_splats, opacities=ball_splats.opacities * 0.1)
    weighted, drawable, cameras = seen(faint)
    covered = [coverage(drawable, camera) for camera in cameras]
    cluttered = [weighted.clutter(camera.position, 1.0) for camera in cameras]

    monkeypatch.setattr(views, "MAX_SAMPLED_SPLATS", len(faint) // 4)

    np.testing.assert_allclose([coverage(drawable, camera) for camera in cameras], covered, atol=0.1)
    np.testing.assert_allclose(
        [weighted.clutter(camera.position, 1.0) for camera in cameras], cluttered, rtol=0.3, atol=0.01
    )

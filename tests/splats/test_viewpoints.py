from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from explicit_balls import ball_splats

from hyrfpack.errors import HyrfDataError
from hyrfpack.splats import viewpoints as views
from hyrfpack.splats.draw import Drawable
from hyrfpack.splats.splats import Splats, concatenate
from hyrfpack.splats.viewpoints import (
    MAX_CLUTTER,
    MIN_COVERAGE,
    OUTSIDE_DISTANCE_RANGE_RADII,
    WeightedSplats,
    measure_coverage,
    sample_viewpoints,
)


def sample_cameras(splats: Splats, count: int = 12, seed: int = 0):
    weighted = WeightedSplats.from_splats(splats, "x")
    drawable = Drawable.from_splats(splats, weighted.frame)
    return weighted, drawable, sample_viewpoints(weighted, drawable, count, 32, seed)


def solid_ball() -> Splats:
    """Return splats that fill the unit ball."""
    splats, depths = ball_splats(400), np.random.default_rng(1).random((400, 1)) ** (1 / 3)
    return replace(splats, positions=splats.positions * depths)


def room() -> Splats:
    """Return large splats on a hollow sphere of radius 5."""
    splats = ball_splats(600)
    return replace(splats, positions=5 * splats.positions, scales=np.full((600, 3), 0.5), opacities=np.full(600, 0.9))


def test_cameras_are_outside_objects_and_inside_rooms() -> None:
    weighted, _, outside = sample_cameras(solid_ball())
    assert all(np.linalg.norm(camera.position) > 0.9 for camera in outside)
    _, _, inside = sample_cameras(room())
    assert all(np.linalg.norm(camera.position) < 5 for camera in inside)


def test_cameras_have_enough_coverage_and_little_clutter() -> None:
    weighted, drawable, cameras = sample_cameras(solid_ball())
    assert min(measure_coverage(drawable, camera) for camera in cameras) >= MIN_COVERAGE
    assert max(weighted.estimate_clutter(camera.position) for camera in cameras) <= MAX_CLUTTER
    reach = weighted.radius * OUTSIDE_DISTANCE_RANGE_RADII[1] + 1
    assert max(np.linalg.norm(camera.position) for camera in cameras) <= reach


def test_cameras_depend_on_the_seed_alone() -> None:
    first, again, other = (
        np.array([camera.position for camera in sample_cameras(solid_ball(), seed=seed)[2]]) for seed in (0, 0, 1)
    )
    assert np.array_equal(first, again)
    assert np.abs(first - other).max(1).min() > 0.01


def test_a_far_away_splat_does_not_enlarge_the_frame() -> None:
    splats = solid_ball()
    positions = splats.positions.copy()
    positions[0] = 1e5
    assert WeightedSplats.from_splats(replace(splats, positions=positions), "x").frame.scale < 2


def test_sky_splats_do_not_enlarge_the_frame() -> None:
    ground, sky = solid_ball(), room()
    sky = replace(sky, positions=100 * sky.positions, scales=100 * sky.scales)
    weighted, drawable, cameras = sample_cameras(concatenate((replace(ground, scales=ground.scales / 2), sky[::10])))
    assert weighted.frame.scale < 2
    assert np.abs([camera.position for camera in cameras]).max() < 10


def test_sampling_a_quarter_of_the_splats_gives_similar_scores(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each sampled splat counts four times; where many overlap, coverage and clutter hardly change."""
    splats = solid_ball()
    faint = replace(splats, opacities=splats.opacities * 0.1)
    weighted, drawable, cameras = sample_cameras(faint)
    covered = [measure_coverage(drawable, camera) for camera in cameras]
    cluttered = [weighted.estimate_clutter(camera.position, 1.0) for camera in cameras]

    monkeypatch.setattr(views, "MAX_SAMPLED_SPLATS", len(faint) // 4)

    np.testing.assert_allclose([measure_coverage(drawable, camera) for camera in cameras], covered, atol=0.1)
    np.testing.assert_allclose(
        [weighted.estimate_clutter(camera.position, 1.0) for camera in cameras], cluttered, rtol=0.3, atol=0.01
    )


@pytest.mark.parametrize(
    ("splats", "problem"),
    [
        (ball_splats(5)[np.zeros(5, bool)], "ball.ply: there is no Gaussian in it"),
        (replace(ball_splats(5), opacities=np.zeros(5)), "ball.ply: no Gaussian is visible"),
        (
            replace(ball_splats(5), positions=np.full((5, 3), 1e9, np.float32), scales=np.full((5, 3), 1e-9)),
            "ball.ply: all Gaussians lie at one place",
        ),
    ],
)
def test_splats_that_nothing_can_be_seen_of_are_named(splats: Splats, problem: str) -> None:
    with pytest.raises(HyrfDataError, match=problem):
        WeightedSplats.from_splats(splats, "ball.ply")

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scenes import camera_at, ring, shift_cameras

from hyrfpack.cameras.paths import Viewpoint, look_at, orbit
from hyrfpack.scene import Camera


def azimuths(cameras, center=(0, 0, 0)) -> np.ndarray:
    """Return azimuths around the z axis in degrees."""
    offsets = np.array([camera.position for camera in cameras]) - center
    return np.degrees(np.arctan2(offsets[:, 1], offsets[:, 0]))


def ring_part(first: float, last: float, count: int = 15) -> list[Camera]:
    """Return cameras on an arc of radius 3 and height 1 between two azimuths in degrees."""
    angles = np.radians(np.linspace(first, last, count))
    return [camera_at((3 * math.cos(a), 3 * math.sin(a), 1)) for a in angles]


def test_the_typical_camera_is_not_an_outlier():
    odd = camera_at((40, 0, 30))
    assert np.linalg.norm(np.array(orbit(Viewpoint.from_cameras([odd, *ring(8)]), 1)[0].position)) < 4


@pytest.mark.parametrize(("first", "last"), [(-30, 60), (100, 250), (170, 200), (350, 480)])
def test_swing_stays_on_the_arc_that_the_photos_cover(first, last):
    cameras = ring_part(first, last)
    path = orbit(Viewpoint.from_cameras(cameras), 40)
    middle = (first + last) / 2
    seen = (azimuths(path) - middle + 180) % 360 - 180
    assert seen.min() == pytest.approx(first - middle, abs=1)
    assert seen.max() == pytest.approx(last - middle, abs=1)


def test_an_orbit_of_cameras_that_look_outwards_is_not_around_the_point_behind_them():
    cameras = [camera_at(camera.position, 2 * camera.position) for camera in ring(8, elevation=0.0)]
    path = orbit(Viewpoint.from_cameras(cameras), 8)
    assert all(camera.forward @ path[0].forward > 0.9 for camera in path)


@pytest.mark.parametrize("count", [1, 2])
def test_one_or_two_cameras_are_enough(count):
    path = orbit(Viewpoint.from_cameras(ring(8)[:count]), 3)
    assert all(np.isfinite(camera.camera_from_world).all() for camera in path)


def test_a_real_capture_is_orbited_among_its_cameras(shared_data):
    from hyrfpack.data import load_scene

    cameras = [view.camera for view in load_scene(shared_data / "mipnerf360_bonsai").train]
    path = orbit(Viewpoint.from_cameras(cameras), 12)
    positions = np.array([camera.position for camera in cameras])
    nearest = [np.linalg.norm(positions - camera.position, axis=1).min() for camera in path]
    assert max(nearest) < 0.3 * np.ptp(positions, axis=0).max()


def test_orbit_looks_at_the_centre_from_the_typical_distance_and_height():
    center = np.array([5.0, -7.0, 11.0])
    path = orbit(Viewpoint.from_cameras(shift_cameras(ring(10, radius=3, height=1), center)), 24)
    for camera in path:
        local = camera.camera_from_world @ [*center, 1]
        np.testing.assert_allclose(local[:3], (0, 0, math.sqrt(10)), atol=1e-9)
        np.testing.assert_allclose(camera.rotation @ camera.rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(camera.rotation) == pytest.approx(1)
        assert camera.position[2] == pytest.approx(12)
        assert camera.rotation[1, 2] < 0  # y points down, so the horizon is upright
    steps = np.diff(np.unwrap(azimuths(path, center), period=360))
    np.testing.assert_allclose(np.abs(steps), 15, atol=1e-6)


def test_orbit_around_a_place_seen_from_straight_above_is_a_circle():
    above = camera_at((0, 0, 5), up=(0, 1, 0))
    viewpoint = replace(Viewpoint.from_cameras(ring(6)), camera=above)
    positions = np.array([camera.position for camera in orbit(viewpoint, 6)])
    assert np.ptp(positions, axis=0)[:2].min() > 1


@pytest.mark.parametrize("scale", [1e-30, 1e-13, 1.0, 1e20])
def test_an_orbit_looks_at_the_centre_of_a_scene_of_any_unit(scale):
    for camera in orbit(Viewpoint.from_frame((0.0, 0.0, 0.0), scale), 4):
        direction = -camera.position / np.abs(camera.position).max()
        assert camera.forward @ direction == pytest.approx(np.linalg.norm(direction))


def test_look_at_accepts_a_viewing_direction_along_up():
    pose = look_at(np.array([0.0, 0.0, 2.0]), np.zeros(3), np.array([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(pose @ [0, 0, 0, 1], [0, 0, 2, 1], atol=1e-12)

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scenes import camera_at, look_at

from hyrfpack.errors import HyrfDataError
from hyrfpack.model import Frame
from hyrfpack.model.frame import MIN_HALF_EXTENT
from hyrfpack.scene import Camera


def make_camera(position=(3.0, -2.0, 1.0), target=(0.1, 0.2, 0.3)) -> Camera:
    return Camera(64, 48, 70.0, 65.0, 30.0, 25.0, look_at(position, target))


def project(points: np.ndarray, pose: np.ndarray, camera: Camera) -> np.ndarray:
    """Return (N, 3) column, row and depth by the pinhole formula."""
    x, y, z = (points @ pose[:3, :3].T + pose[:3, 3]).T
    return np.stack((camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy, z), axis=1)


@pytest.mark.parametrize("offset", [0.0, 1e6])
@pytest.mark.parametrize("rotation", [(1.0, 0.0, 0.0, 0.0), (0.5, -0.1, 0.7, 0.5)], ids=["straight", "rotated"])
def test_local_pose_sees_the_same_pixels_with_depth_in_local_units(offset, rotation):
    shift = np.array([offset, -offset, offset / 2])
    points = np.random.default_rng(4).uniform(-1, 1, (100, 3)) + shift
    camera = make_camera(shift + (3.0, -2.0, 1.0), shift + (0.1, 0.2, 0.3))
    frame = replace(Frame.from_box(shift - (2, 3, 1), shift + (2.5, 3, 0.5)), rotation=rotation)

    local = project(frame.to_local(points), frame.local_pose(camera), camera)

    world = project(points, camera.camera_from_world, camera)
    np.testing.assert_allclose(local[:, :2], world[:, :2], rtol=0, atol=1e-6)
    np.testing.assert_allclose(local[:, 2] * frame.scale, world[:, 2], rtol=0, atol=1e-7)


def test_local_pose_keeps_a_close_scene_exact_a_million_units_away():
    """This holds even after rounding to float32, because the kernels get small numbers."""
    shift = np.array([1e6, 1e6, -1e6])
    points = np.random.default_rng(5).uniform(-1, 1, (100, 3))
    near, far = make_camera(), make_camera(shift + (3.0, -2.0, 1.0), shift + (0.1, 0.2, 0.3))
    frame = Frame.from_box(shift - 1, shift + 1)

    local = frame.to_local(points + shift).astype(np.float32)
    seen = project(local, frame.local_pose(far).astype(np.float32), far)

    np.testing.assert_allclose(seen[:, :2], project(points, near.camera_from_world, near)[:, :2], rtol=0, atol=1e-3)


def test_a_rotated_frame_maps_its_own_axes_to_the_coordinate_axes():
    """A right-handed turn by 90 degrees about z maps x to y, y to -x, and z to itself."""
    half = math.sqrt(0.5)
    frame = Frame((10.0, 20.0, 30.0), 2.0, (1.0, 1.0, 1.0), (half, 0.0, 0.0, half))
    world = np.array([[10.0, 22.0, 30.0], [8.0, 20.0, 30.0], [10.0, 20.0, 32.0]])  # the centre + 2 times each axis

    np.testing.assert_allclose(frame.to_local(world), np.eye(3), rtol=0, atol=1e-15)
    np.testing.assert_allclose(frame.to_world(np.eye(3)), world, rtol=0, atol=1e-14)


@pytest.mark.parametrize(
    "rotation", [(0.0, 0.0, 0.0, 0.0), (1.0, 1.0, 0.0, 0.0), (1 + 2e-6, 0.0, 0.0, 0.0), (float("nan"), 0, 0, 1)]
)
def test_a_frame_refuses_a_rotation_that_is_no_unit_quaternion(rotation):
    with pytest.raises(ValueError, match="unit length"):
        Frame((0.0, 0.0, 0.0), 1.0, (1.0, 1.0, 1.0), rotation)


def test_local_pose_does_not_change_the_camera():
    camera = make_camera()
    before = camera.camera_from_world.copy()
    Frame.from_box(np.full(3, 3.0), np.full(3, 9.0)).local_pose(camera)
    assert np.array_equal(camera.camera_from_world, before)


def test_millimetres_and_kilometres_give_the_same_local_coordinates():
    points = np.random.default_rng(6).uniform(-5, 5, (50, 3))
    low, high = points.min(0), points.max(0)
    camera = camera_at((7.0, 1.0, 2.0))
    results = []
    for unit in (1e3, 1e-3):  # the same lengths, in mm and in km
        pose = camera.camera_from_world.copy()
        pose[:3, 3] *= unit
        frame = Frame.from_box(low * unit, high * unit)
        local_pose = frame.local_pose(Camera(32, 32, *camera.intrinsics, pose))
        results.append((frame.to_local(points * unit), local_pose, frame.half_extent))

    for in_mm, in_km in zip(*results, strict=True):
        np.testing.assert_allclose(in_mm, in_km, rtol=1e-12, atol=1e-12)


def test_to_world_undoes_to_local():
    frame = Frame.from_box(np.array([-1.0, 4, 1e5]), np.array([2.0, 9, 1e5 + 3]))
    points = np.random.default_rng(7).normal(size=(20, 3)) * 100 + frame.center
    np.testing.assert_allclose(frame.to_world(frame.to_local(points)), points, rtol=1e-14)


def test_from_box_puts_the_corners_at_the_half_extent():
    low, high = np.array([-1.0, 2, 10]), np.array([3.0, 4, 12])

    frame = Frame.from_box(low, high)

    assert frame.center == (1.0, 3.0, 11.0) and frame.scale == 2.0
    np.testing.assert_allclose(frame.to_local(np.stack([low, high])), [[-1, -0.5, -0.5], [1, 0.5, 0.5]])
    np.testing.assert_allclose(frame.to_local(np.stack([low, high])) / frame.half_extent, [[-1, -1, -1], [1, 1, 1]])


def test_from_box_widens_flat_axes():
    frame = Frame.from_box(np.array([0.0, 5, -8]), np.array([0.0, 5, 8]))  # a row of cameras
    assert frame.scale == 8 and frame.half_extent == (MIN_HALF_EXTENT, MIN_HALF_EXTENT, 1.0)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("corner", ["low", "high"])
def test_from_box_rejects_corners_that_are_not_finite(bad, corner):
    low, high = np.zeros(3), np.ones(3)
    (low if corner == "low" else high)[1] = bad
    with pytest.raises(HyrfDataError, match="not finite"):
        Frame.from_box(low, high)


def test_from_box_rejects_a_box_without_size():
    with pytest.raises(HyrfDataError, match="no size"):
        Frame.from_box(np.full(3, 2.5), np.full(3, 2.5))

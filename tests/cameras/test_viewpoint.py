from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from made_up_cameras import cameras
from scenes import camera_at, ring, shift_cameras
from scipy.spatial.transform import Rotation

from hyrfpack.cameras.capture import Capture
from hyrfpack.cameras.paths import Viewpoint, common_direction, estimate_up, orbit
from hyrfpack.scene import Camera


@pytest.mark.parametrize("offset", [(0, 0, 0), (1e6, -2e6, 3e5)])
def test_the_viewpoint_of_cameras_around_an_object_is_centred_on_it(offset):
    hint = Viewpoint.from_cameras(shift_cameras(ring(12), offset))
    np.testing.assert_allclose(hint.center, offset, atol=1e-6)
    np.testing.assert_allclose(hint.up, (0, 0, 1), atol=1e-9)
    assert hint.arc == (0.0, 360.0)
    assert (hint.camera.width, hint.camera.height, list(hint.camera.intrinsics)) == (32, 32, [32.0, 32.0, 16.0, 16.0])


def test_up_is_the_axis_about_which_cameras_are_level():
    on_a_part = [camera_at((3 * math.cos(a), 3 * math.sin(a), 2.5)) for a in np.linspace(0, 1.5, 9)]
    np.testing.assert_allclose(Viewpoint.from_cameras(on_a_part).up, (0, 0, 1), atol=1e-9)
    almost_above = [camera_at((1.7 * math.cos(a), 1.7 * math.sin(a), 9)) for a in np.linspace(0, 2.5, 9)]
    np.testing.assert_allclose(Viewpoint.from_cameras(almost_above).up, (0, 0, 1), atol=1e-9)


def turned(cameras: list[Camera], rotation: np.ndarray) -> list[Camera]:
    """Return cameras of a scene that is rotated about the origin."""
    poses = [np.block([[c.rotation @ rotation.T, c.camera_from_world[:3, 3:]], [np.eye(4)[3:]]]) for c in cameras]
    return [replace(camera, camera_from_world=pose) for camera, pose in zip(cameras, poses, strict=True)]


def flight(mount_degrees: float, climb: float = 0.0, rows: int = 4) -> list[Camera]:
    """Return cameras that fly to and fro over z = 0 and look down, with a mount that is tilted along their right axes.

    Their tilts to both sides cancel only partly, because the first rows look along x and the last one along -x.
    """
    tilt = Rotation.from_euler("y", mount_degrees, degrees=True).as_matrix()
    cameras = []
    for row in range(rows):
        for place in range(5):
            up = (1, 0, 0) if row % 2 == 0 else (-1, 0, 0)
            camera = camera_at((place, row, 9 + climb * (place + row)), (place, row, 0), up)
            pose = camera.camera_from_world.copy()
            pose[:3] = tilt @ pose[:3]
            cameras.append(replace(camera, camera_from_world=pose))
    return cameras


ANY_TURN = Rotation.from_rotvec([0.5, -1.2, 2.0]).as_matrix()


@pytest.mark.parametrize("turn", [np.eye(3), ANY_TURN], ids=["straight", "turned"])
def test_up_of_level_cameras_is_perpendicular_to_their_right_axes(turn):
    up, basis = estimate_up(turned(ring(9, elevation=2.0), turn))
    np.testing.assert_allclose(up, turn @ (0, 0, 1), atol=1e-9)
    assert "level" in basis


@pytest.mark.parametrize("turn", [np.eye(3), ANY_TURN], ids=["straight", "turned"])
def test_up_of_a_flight_is_perpendicular_to_it_whatever_its_mount(turn):
    up, basis = estimate_up(turned(flight(5, rows=3), turn))
    np.testing.assert_allclose(up, turn @ (0, 0, 1), atol=1e-9)
    assert "plane" in basis


def test_up_of_a_flight_along_a_line_is_opposite_to_its_views():
    cameras = [camera_at((k, 0, 9), (k, 0, 0), (-1) ** k * np.array([1.0, 0, 0])) for k in range(8)]
    up, basis = estimate_up(cameras)
    np.testing.assert_allclose(up, (0, 0, 1), atol=1e-9)
    assert "views" in basis


def test_up_of_cameras_on_a_drive_is_the_mean_of_their_up_axes():
    cameras = [camera_at((0, k, 0), (0, k + 1, 0.1 if k % 2 else -0.1)) for k in range(10)]  # pitch up and down
    up, basis = estimate_up(cameras)
    np.testing.assert_allclose(up, (0, 0, 1), atol=1e-9)
    assert "mean" in basis


def test_the_viewpoint_converts_to_json():
    hint = Viewpoint.from_cameras(ring(5)).to_json()
    assert json.loads(json.dumps(hint, allow_nan=False)) == hint


def test_cameras_that_look_the_same_way_get_a_small_swing_in_front_of_them():
    cameras = [camera_at((x, -5.0, 0.0), (x, 0.0, 0.0)) for x in np.linspace(-1, 1, 9)]
    hint = Viewpoint.from_cameras(cameras)
    assert hint.center[1] > -5
    assert hint.arc == (-10.0, 10.0)


def test_a_file_without_a_viewpoint_is_orbited_by_its_frame():
    facts = {"provenance": {}, "config": {"frame": {"center": [1.0, 2.0, 3.0], "scale": 4.0}}}
    assert Capture(facts).viewpoint.to_json() == Viewpoint.from_frame([1.0, 2.0, 3.0], 4.0).to_json()
    for camera in orbit(Capture(facts).viewpoint, 5):
        assert np.linalg.norm(camera.position - (1, 2, 3)) == pytest.approx(10)
        assert camera.position[1] < 2  # it looks down, because up is -y
        assert camera.forward @ (camera.position - (1, 2, 3)) == pytest.approx(-10)


STORED_VIEWPOINT = {
    "center": [0.5, -1.0, 2.0],
    "up": [0.0, -2.0, 0.0],
    "camera_from_world": [[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.5], [0.0, 1.0, 0.0, 4.0], [0.0, 0.0, 0.0, 1.0]],
    "intrinsics": [700.0, 650.5, 400.0, 300.25],
    "width": 800,
    "height": 600,
    "arc": [-30.0, 60.5],
}


def test_the_stored_layout_has_not_changed_since_earlier_versions():
    viewpoint = Viewpoint.from_json(STORED_VIEWPOINT)
    assert json.dumps(viewpoint.to_json()) == json.dumps(STORED_VIEWPOINT)
    assert viewpoint.camera.intrinsics == (700, 650.5, 400, 300.25) and viewpoint.arc == (-30, 60.5)
    assert viewpoint.camera.position.tolist() == [0, -4, 0.5]


@given(camera=cameras())
def test_a_viewpoint_survives_json_exactly(camera):
    stored = json.dumps(Viewpoint.from_cameras([camera]).to_json())
    assert json.dumps(Viewpoint.from_json(json.loads(stored)).to_json()) == stored


@pytest.mark.parametrize("center", [[1e38, 0, 0], [0, -1e160, 0]])
def test_a_centre_without_a_possible_camera_is_rejected(center):
    with pytest.raises(ValueError, match="not finite"):
        Viewpoint.from_json({**STORED_VIEWPOINT, "center": center})
    (camera,) = orbit(Viewpoint.from_json({**STORED_VIEWPOINT, "center": [9e36, 0, 0]}), 1)
    assert np.isfinite(camera.camera_from_world.astype(np.float32)).all()


def test_the_common_direction_of_cameras_is_found_or_none():
    ahead = [camera_at((x, -5.0, 0.0), (x, 0.0, 0.0)) for x in (-1.0, 0.0, 1.0)]
    np.testing.assert_allclose(common_direction(ahead), (0, 1, 0), atol=1e-12)
    assert common_direction(ring(8)) is None

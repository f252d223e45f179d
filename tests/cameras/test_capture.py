from __future__ import annotations

import json
import math
import zlib
from dataclasses import replace

import numpy as np
import pytest
from scenes import ball_scene, ring
from scipy.spatial.transform import Rotation

from hyrfpack.cameras.capture import (
    COARSE_POSE_STEPS_PER_SCENE_SCALE,
    FALLBACK_ORBIT_CAMERAS,
    MAX_STORED_CAMERAS,
    MIN_COARSE_CAMERAS,
    Capture,
    has_mean_exposure,
    provenance_cameras,
    quantized_provenance,
    scene_provenance,
)
from hyrfpack.cameras.files import camera_from_numbers
from hyrfpack.cameras.paths import Viewpoint, orbit
from hyrfpack.errors import HyrfDataError
from hyrfpack.scene import Camera, evenly_spaced

GEOCENTRIC_POSITION = np.array([4027893.7, 1307045.2, 4919474.9])  # metres from the centre of the earth


def make_description(**provenance) -> dict:
    """Return the description of a file with this provenance."""
    return {"provenance": provenance, "config": {"frame": {"center": [0.0, 0.0, 0.0], "scale": 1.0}}}


def test_the_stored_layout_has_not_changed_since_earlier_versions():
    pose = [[0.0, 0.0, 1.0, 12345678.1234567], [0.0, 1.0, 0.0, 1 / 3], [-1.0, 0.0, 0.0, -2.0]]
    row = [800, 600, 700.123457, 650.0, 400.5, 300.0, 0.0, 0.0, 1.0, 12345678.123457]
    row += [0.0, 1.0, 0.0, 0.333333333, -1.0, 0.0, 0.0, -2.0]
    assert json.dumps(provenance_cameras([Camera(800, 600, 700.1234567, 650.0, 400.5, 300.0, pose)])) == json.dumps(
        [row]
    )


def test_the_capture_stored_with_a_model_is_read_back():
    scene = replace(ball_scene(5), max_size=700)
    capture = Capture(make_description(**json.loads(json.dumps(scene_provenance(scene)))))
    photographed = [view.camera for view in scene.train]
    assert capture.max_size == 700 and not capture.is_synthetic
    assert capture.viewpoint.to_json() == Viewpoint.from_cameras(photographed).to_json()
    assert provenance_cameras(capture.cameras) == provenance_cameras(photographed)


def test_only_files_of_earlier_versions_have_a_mean_exposure():
    assert has_mean_exposure({"mean_exposure": True}) and not has_mean_exposure(scene_provenance(ball_scene(5)))
    assert not has_mean_exposure({"mean_exposure": "yes"})


def test_only_some_of_many_cameras_are_stored():
    assert len(provenance_cameras(ring(MAX_STORED_CAMERAS + 9))) == MAX_STORED_CAMERAS


def test_cameras_come_from_photos_then_from_the_file_then_from_an_orbit():
    scene, kept = ball_scene(5), {"cameras": provenance_cameras(ring(3))}
    assert Capture(make_description(**kept), scene).cameras == [view.camera for view in scene.train]
    held_out = replace(scene, train=[], test=scene.train)
    for capture in (Capture(make_description(**kept)), Capture(make_description(**kept), held_out)):
        assert len(capture.cameras) == 3 and not capture.is_synthetic
    assert (
        Capture(make_description()).is_synthetic and len(Capture(make_description()).cameras) == FALLBACK_ORBIT_CAMERAS
    )
    assert not Capture(make_description(), scene).is_synthetic


@pytest.mark.parametrize("scale", [1e-30, 1e-12, 1e-4, 1.0, 250.0])
@pytest.mark.parametrize("away", [0.0, 3e4])
def test_coarse_cameras_approximate_the_original_cameras(scale, away):
    cameras = []
    for camera in ring(40):
        pose = camera.camera_from_world.copy()
        pose[:3, 3] = -pose[:3, :3] @ (scale * (camera.position + away))
        cameras.append(replace(camera, camera_from_world=pose))
    provenance = {
        "cameras": provenance_cameras(cameras),
        "viewpoint": Viewpoint.from_cameras(cameras).to_json(),
        "seed": 3,
    }

    kept = json.loads(json.dumps(quantized_provenance(provenance, scale)))

    capture = Capture(make_description(**kept))
    assert {*kept} == {"coarse_cameras", "viewpoint", "seed"} and capture.is_coarse and not capture.is_synthetic
    assert len(capture.cameras) == MIN_COARSE_CAMERAS and quantized_provenance(kept, scale) == kept
    for rough, exact in zip(capture.cameras, evenly_spaced(cameras, MIN_COARSE_CAMERAS), strict=True):
        assert np.linalg.norm(rough.position - exact.position) < 3 * scale / COARSE_POSE_STEPS_PER_SCENE_SCALE
        np.testing.assert_allclose(rough.rotation, exact.rotation, atol=1e-4)
        np.testing.assert_allclose(rough.intrinsics, exact.intrinsics, atol=0.051)
    center = capture.viewpoint.center - Viewpoint.from_cameras(cameras).center
    assert np.abs(center).max() < 1e-6 * scale * max(away, 1)


def test_coarse_cameras_take_about_30_bytes_each():
    cameras = [replace(camera, fx=71.23456789, fy=71.3) for camera in ring(40)]
    kept = quantized_provenance({"cameras": provenance_cameras(cameras)}, 1.0)
    assert len(zlib.compress(json.dumps(kept["coarse_cameras"]).encode(), 9)) < 45 * MIN_COARSE_CAMERAS


def test_invalid_cameras_and_viewpoints_are_omitted():
    assert quantized_provenance({"cameras": [[1, 2]], "viewpoint": 7, "steps": 5}, 1.0) == {"viewpoint": 7, "steps": 5}
    assert quantized_provenance({"cameras": "none", "seed": 1}, 1.0) == {"seed": 1}
    assert quantized_provenance({}, 1.0) == {}


def test_exact_cameras_are_preferred_to_coarse_ones():
    rough = quantized_provenance({"cameras": provenance_cameras(ring(3))}, 1.0)
    capture = Capture(make_description(cameras=provenance_cameras(ring(5)), **rough))
    assert len(capture.cameras) == 5 and not capture.is_coarse


def test_a_stored_viewpoint_is_read_only_when_requested():
    assert len(Capture(make_description(cameras=provenance_cameras(ring(3)), viewpoint=7)).cameras) == 3


@pytest.mark.parametrize("cameras", [7, [[1, 2, 3]], [[32, 32, 0, 1, 1, 1, *range(12)]], {"a": 1}])
def test_invalid_cameras_are_a_clear_error(cameras):
    with pytest.raises(HyrfDataError, match=r"cameras that the file keeps are not valid [^\n]*`data`$"):
        _ = Capture(make_description(cameras=cameras)).cameras


@pytest.mark.parametrize(
    "change",
    [
        {"center": [0, 0]},
        {"center": "here"},
        {"up": [0, 0, 0]},
        {"up": None},
        {"intrinsics": [0, 1, 2, 3]},
        {"intrinsics": [1, 2, 3]},
        {"width": 0},
        {"height": 1e9},
        {"arc": [0, math.inf]},
        {"camera_from_world": [[1, 2], [3, 4]]},
        {"camera_from_world": (2 * np.eye(4)).tolist()},
    ],
)
def test_a_forged_viewpoint_is_an_error_about_the_file(change):
    with pytest.raises(HyrfDataError, match="viewpoint"):
        orbit(Capture(make_description(viewpoint={**Viewpoint.from_cameras(ring(3)).to_json(), **change})).viewpoint, 2)


@pytest.mark.parametrize("kind", ["all cameras", "coarse cameras"])
def test_training_photos_match_the_stored_cameras_also_with_another_split(kind):
    scene = ball_scene(20)
    kept = scene_provenance(scene)
    capture = Capture(make_description(**(kept if kind == "all cameras" else quantized_provenance(kept, 1.0))), scene)
    assert capture.mismatch == ""
    half = replace(scene, train=scene.test, test=scene.train[::2])
    assert replace(capture, scene=half).mismatch == ""


@pytest.mark.parametrize("kind", ["all cameras", "coarse cameras"])
def test_photos_of_another_scene_or_frame_do_not_match_the_stored_cameras(kind):
    scene = ball_scene(20)
    kept = scene_provenance(scene)
    model = make_description(**(kept if kind == "all cameras" else quantized_provenance(kept, 1.0)))
    moved_world, turned_world = np.eye(4), np.diag([-1.0, 1.0, -1.0, 1.0])
    moved_world[0, 3] = 0.5
    for change in (moved_world, turned_world):
        views = [
            replace(view, camera=replace(view.camera, camera_from_world=view.camera.camera_from_world @ change))
            for view in scene.train
        ]
        sentence = Capture(model, replace(scene, path="other", train=views, test=[])).mismatch
        assert sentence.startswith("other: of the ") and "another coordinate frame" in sentence


@pytest.mark.parametrize("scale", [0.075, 1.0])
@pytest.mark.parametrize("kind", ["all cameras", "coarse cameras"])
def test_photos_in_geocentric_coordinates_match_the_cameras_of_their_model(kind, scale):
    turn = Rotation.random(random_state=1).as_matrix()
    cameras = []
    for view in ball_scene(24).train:
        pose = view.camera.camera_from_world.copy()
        pose[:3, :3] = pose[:3, :3] @ turn
        pose[:3, 3] = scale * pose[:3, 3] - pose[:3, :3] @ GEOCENTRIC_POSITION
        cameras.append(replace(view.camera, camera_from_world=pose))
    views = [replace(view, camera=camera) for view, camera in zip(ball_scene(24).train, cameras, strict=True)]
    scene = replace(ball_scene(24), train=views, test=[])
    kept = json.loads(json.dumps(scene_provenance(scene)))
    kept = kept if kind == "all cameras" else json.loads(json.dumps(quantized_provenance(kept, scale)))
    facts = make_description(**kept)
    facts["config"]["frame"]["scale"] = scale

    assert Capture(facts, scene).mismatch == ""
    if kind == "all cameras":
        stored = [camera_from_numbers(numbers) for numbers in kept["cameras"]]
        moved = [np.abs(mine.position - given.position).max() for mine, given in zip(stored, cameras, strict=True)]
        assert max(moved) < 1e-5


def test_one_common_camera_is_not_enough_for_a_match():
    scene, other = ball_scene(20), ball_scene(20, offset=(40.0, 0.0, 0.0))
    other.train[3] = replace(other.train[3], camera=scene.train[3].camera)
    sentence = Capture(make_description(**scene_provenance(scene)), other).mismatch
    assert f"of the {len(scene.train)} cameras that the model keeps of its training, 1 is among" in sentence


def test_without_photos_or_kept_cameras_there_is_no_mismatch():
    scene = ball_scene(5)
    assert Capture(make_description(**scene_provenance(scene))).mismatch == ""
    assert Capture(make_description(), scene).mismatch == ""
    assert Capture(make_description(cameras=[["damaged"]]), scene).mismatch == ""


def test_a_camera_as_near_to_a_photo_of_training_as_to_a_held_out_one_says_nothing():
    """Two photos may be taken from one place, as with a bracket of exposures."""
    cameras, scene = ring(4), ball_scene(4)
    views = [replace(view, camera=camera) for view, camera in zip(scene.train, cameras, strict=True)]
    facts = make_description(cameras=provenance_cameras(cameras))
    assert Capture(facts, replace(scene, train=views[:3], test=views[3:])).leak
    assert not Capture(facts, replace(scene, train=views, test=views[3:])).leak
    assert not Capture(facts, replace(scene, train=[], test=views)).leak
    assert not Capture(make_description(), replace(scene, train=views[:3], test=views[3:])).leak

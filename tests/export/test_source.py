"""What is exported is a model and the cameras that it was, or may have been, photographed with."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import ball_scene, ring, small_model

from hyrfpack.cameras.capture import provenance_cameras
from hyrfpack.cameras.paths import Viewpoint
from hyrfpack.errors import HyrfError
from hyrfpack.export.source import MAX_MEASURED_VIEWS, MIN_CAMERAS_TO_HOLD_OUT, Source
from hyrfpack.format import save_model
from hyrfpack.scene import Camera, Scene

POSITIONS = np.random.default_rng(0).uniform(-0.6, 0.6, (20, 3))


@pytest.fixture
def written(tmp_path):
    """Writes a model with a provenance; returns its path."""

    def write(provenance=None, positions=POSITIONS):
        path = tmp_path / "model.hyrf"
        save_model(small_model(positions), path, provenance=provenance)
        return path

    return write


def kept(count: int) -> dict:
    cameras = ring(count)
    return {"cameras": provenance_cameras(cameras), "viewpoint": Viewpoint.from_cameras(cameras).to_json()}


def places(cameras) -> set[tuple[float, ...]]:
    return {tuple(camera.position.round(6)) for camera in cameras}


def split(scene: Scene) -> Scene:
    """With every fourth photo held out."""
    held = scene.train[::4]
    return replace(scene, train=[view for view in scene.train if view not in held], test=held)


@pytest.mark.parametrize("count", [MIN_CAMERAS_TO_HOLD_OUT, 40, 128])
def test_cameras_that_are_measured_at_are_not_fitted(count, written):
    source = Source.read(written(kept(count)))
    fitted, measured = places(source.fit_cameras), places(camera for camera, _ in source.measured_views)
    assert not fitted & measured and 2 <= len(measured) <= MAX_MEASURED_VIEWS
    assert len(source.cameras) == count and len(fitted) == count - len(range(0, count, 8))


def test_of_few_cameras_none_is_spared(written):
    source = Source.read(written(kept(MIN_CAMERAS_TO_HOLD_OUT - 1)))
    assert len(source.fit_cameras) == MIN_CAMERAS_TO_HOLD_OUT - 1
    assert places(camera for camera, _ in source.measured_views) <= places(source.fit_cameras)


def test_a_camera_that_is_kept_is_the_one_that_was_photographed_with(written):
    cameras = ring(5, width=40, height=30)
    source = Source.read(written({"cameras": provenance_cameras(cameras)}))
    for (name, back), camera in zip(source.cameras, cameras, strict=True):
        assert name.endswith(".png") and (back.width, back.height, back.fx) == (40, 30, camera.fx)
        assert np.allclose(back.camera_from_world, camera.camera_from_world, atol=1e-7)
    assert len({name for name, _ in source.cameras}) == 5


def test_which_way_is_up_and_what_is_looked_at_come_from_the_capture(written):
    source = Source.read(written(kept(12)))  # a ring about the z axis
    assert np.allclose(source.up, (0, 0, 1), atol=1e-6) and np.allclose(source.center, 0, atol=1e-6)


@pytest.mark.parametrize("provenance", [None, {"viewpoint": Viewpoint.from_cameras(ring(9)).to_json()}])
def test_without_cameras_rings_around_the_scene_serve(provenance, written):
    source = Source.read(written(provenance))
    assert source.cameras == [] and source.fit_cameras and len(source.measured_views) == MAX_MEASURED_VIEWS
    assert not places(source.fit_cameras) & places(camera for camera, _ in source.measured_views)
    for camera in source.fit_cameras:
        toward = source.center - camera.position
        assert camera.forward @ toward / np.linalg.norm(toward) == pytest.approx(1)
    assert np.linalg.norm(source.up) == pytest.approx(1)


def test_photos_come_before_the_cameras_that_the_file_keeps(written):
    scene = split(ball_scene(12))
    source = Source.read(written(kept(30)), scene)
    assert source.cameras == [(view.name, view.camera) for view in scene.train]
    assert source.fit_cameras == [view.camera for view in scene.train]
    assert source.measured_views == [(view.camera, view) for view in scene.test]


def test_at_most_so_many_held_out_photos_are_scored(written):
    scene = split(ball_scene(80, side=4))
    assert len(Source.read(written(), scene).measured_views) == MAX_MEASURED_VIEWS < len(scene.test)


def test_without_held_out_photos_there_is_nothing_to_measure_at(written):
    assert Source.read(written(), ball_scene(3)).measured_views == []


BROKEN = {
    "no up": {"center": [0, 0, 0]},
    "up without length": {"up": [0, 0, 0], "center": [0, 0, 0]},
    "up in the plane": {"up": [0, 1], "center": [0, 0, 0]},
    "centre of words": {"up": [0, 1, 0], "center": ["a", "b", "c"]},
    "a table": {"up": [[0, 1, 0]], "center": [0, 0, 0]},
    "a list": [1, 2, 3],
    "a number": 7,
}


@pytest.mark.parametrize("what", BROKEN)
def test_a_viewpoint_without_sense_is_one_sentence(what, written):
    path = written({"viewpoint": BROKEN[what], "cameras": provenance_cameras(ring(3))})
    with pytest.raises(HyrfError, match=r"viewpoint [^\n]*$"):
        Source.read(path)


@pytest.mark.parametrize("cameras", [7, "none", [[1, 2, 3]], [[32, 32, 0, 1, 1, 1, *range(12)]], {"a": 1}])
def test_invalid_cameras_are_a_clear_error(cameras, written):
    with pytest.raises(HyrfError, match=r"cameras that the file keeps are not valid [^\n]*`data`$"):
        Source.read(written({"cameras": cameras}))


def test_an_empty_model_and_no_file_are_one_sentence(written, tmp_path):
    path = written(positions=np.zeros((0, 3)))
    with pytest.raises(HyrfError, match=r"there is no Gaussian in it[^\n]*$"):
        Source.read(path)
    with pytest.raises(HyrfError, match=r"none\.hyrf[^\n]*$"):
        Source.read(tmp_path / "none.hyrf")


def test_up_is_against_cameras_that_look_down_and_turn(written):
    # A drone that flies to and fro over the plane z = 0: half of its pictures stand on their heads.
    poses = [np.eye(4) for _ in range(12)]
    for number, pose in enumerate(poses):
        pose[:3, :3] = np.diag([1.0, -1, -1]) if number % 2 else np.diag([-1.0, 1, -1])
        pose[:3, 3] = -pose[:3, :3] @ (number - 6.0, 0.0, 3.0)
    cameras = [Camera(32, 32, 30.0, 30.0, 16.0, 16.0, pose) for pose in poses]
    kept = {"cameras": provenance_cameras(cameras), "viewpoint": Viewpoint.from_cameras(cameras).to_json()}
    assert np.allclose(Source.read(written(kept)).up, (0, 0, 1))
    kept["cameras"] = provenance_cameras(cameras[::2])  # all the same way up: as likely a wall as the ground
    assert np.allclose(abs(Source.read(written(kept)).up), (0, 1, 0))

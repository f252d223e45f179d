"""An export source is a model with the cameras of its photos, or with cameras chosen for it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import ball_scene, ring, small_model

from hyrfpack.cameras.capture import provenance_cameras, quantized_provenance
from hyrfpack.cameras.paths import Viewpoint
from hyrfpack.errors import HyrfError
from hyrfpack.export import export_model
from hyrfpack.export.source import MAX_MEASURED_VIEWS, MIN_CAMERAS_TO_HOLD_OUT, Source
from hyrfpack.format import save_model
from hyrfpack.scene import Camera, Scene

GAUSSIAN_POSITIONS = np.random.default_rng(0).uniform(-0.6, 0.6, (20, 3))


@pytest.fixture
def write_model(tmp_path):
    """Return a function that writes a model with a provenance and returns its path."""

    def write(provenance=None, positions=GAUSSIAN_POSITIONS):
        path = tmp_path / "model.hyrf"
        save_model(small_model(positions), path, provenance=provenance)
        return path

    return write


def ring_provenance(count: int) -> dict:
    cameras = ring(count)
    return {"cameras": provenance_cameras(cameras), "viewpoint": Viewpoint.from_cameras(cameras).to_json()}


def rounded_positions(cameras) -> set[tuple[float, ...]]:
    return {tuple(camera.position.round(6)) for camera in cameras}


def hold_out_every_fourth(scene: Scene) -> Scene:
    """Return the scene with every fourth photo held out."""
    held = scene.train[::4]
    return replace(scene, train=[view for view in scene.train if view not in held], test=held)


@pytest.mark.parametrize("count", [MIN_CAMERAS_TO_HOLD_OUT, 40, 128])
def test_measured_cameras_are_not_fitted(count, write_model):
    source = Source.read(write_model(ring_provenance(count)))
    fitted, measured = (
        rounded_positions(source.fit_cameras),
        rounded_positions(camera for camera, _ in source.measured_views),
    )
    assert not fitted & measured and 2 <= len(measured) <= MAX_MEASURED_VIEWS
    assert len(source.cameras) == count and len(fitted) == count - len(range(0, count, 8))


@pytest.mark.parametrize(("count", "measured_count"), [(7, 7), (8, 1), (14, 2)])
def test_measured_coarse_cameras_are_not_fitted(count, measured_count, write_model):
    source = Source.read(write_model(quantized_provenance(ring_provenance(count), 1.0)))
    measured = [camera for camera, _ in source.measured_views]
    assert source.has_coarse_cameras and len(measured) == measured_count
    assert len(set(source.fit_cameras) & set(measured)) == (count if count < 8 else 0)


def test_few_cameras_are_all_fitted(write_model):
    source = Source.read(write_model(ring_provenance(MIN_CAMERAS_TO_HOLD_OUT - 1)))
    assert len(source.fit_cameras) == MIN_CAMERAS_TO_HOLD_OUT - 1
    assert rounded_positions(camera for camera, _ in source.measured_views) <= rounded_positions(source.fit_cameras)


def test_stored_cameras_equal_the_cameras_of_the_photos(write_model):
    cameras = ring(5, width=40, height=30)
    source = Source.read(write_model({"cameras": provenance_cameras(cameras)}))
    for (name, back), camera in zip(source.cameras, cameras, strict=True):
        assert name.endswith(".png") and (back.width, back.height, back.fx) == (40, 30, camera.fx)
        assert np.allclose(back.camera_from_world, camera.camera_from_world, atol=1e-7)
    assert len({name for name, _ in source.cameras}) == 5


def test_up_and_center_come_from_the_capture(write_model):
    source = Source.read(write_model(ring_provenance(12)))  # the cameras lie on a ring about the z axis
    assert np.allclose(source.up, (0, 0, 1), atol=1e-6) and np.allclose(source.center, 0, atol=1e-6)


@pytest.mark.parametrize("provenance", [None, {"viewpoint": Viewpoint.from_cameras(ring(9)).to_json()}])
def test_without_cameras_rings_around_the_scene_are_used(provenance, write_model):
    source = Source.read(write_model(provenance))
    assert source.cameras == [] and source.fit_cameras and len(source.measured_views) == MAX_MEASURED_VIEWS
    assert not rounded_positions(source.fit_cameras) & rounded_positions(camera for camera, _ in source.measured_views)
    for camera in source.fit_cameras:
        toward = source.center - camera.position
        assert camera.forward @ toward / np.linalg.norm(toward) == pytest.approx(1)
    assert np.linalg.norm(source.up) == pytest.approx(1)


def test_photos_take_precedence_over_stored_cameras(write_model):
    scene = hold_out_every_fourth(ball_scene(12))
    source = Source.read(write_model(ring_provenance(24)), scene)  # every other one is that of a photo
    assert source.cameras == [(view.name, view.camera) for view in scene.train]
    assert source.fit_cameras == [view.camera for view in scene.train]
    assert source.measured_views == [(view.camera, view) for view in scene.test]


@pytest.mark.parametrize("target", ["out.ply", "out.json", "out.html", "out"])
def test_photos_in_another_frame_are_refused_before_any_work(target, write_model, tmp_path, monkeypatch):
    path = write_model(ring_provenance(12))
    monkeypatch.setattr("hyrfpack.export.source.load_model_or_parts", None)
    with pytest.raises(HyrfError, match=r"balls: of the 12 cameras .* another coordinate frame; name the photos"):
        export_model(path, tmp_path / target, data=ball_scene(12, offset=(5, 0, 0)))
    assert list(tmp_path.iterdir()) == [path]


def test_the_number_of_scored_held_out_photos_is_limited(write_model):
    scene = hold_out_every_fourth(ball_scene(80, side=4))
    assert len(Source.read(write_model(), scene).measured_views) == MAX_MEASURED_VIEWS < len(scene.test)


def test_without_held_out_photos_no_view_is_measured(write_model):
    assert Source.read(write_model(), ball_scene(3)).measured_views == []


INVALID_VIEWPOINTS = {
    "no up": {"center": [0, 0, 0]},
    "up without length": {"up": [0, 0, 0], "center": [0, 0, 0]},
    "up in the plane": {"up": [0, 1], "center": [0, 0, 0]},
    "centre of words": {"up": [0, 1, 0], "center": ["a", "b", "c"]},
    "a table": {"up": [[0, 1, 0]], "center": [0, 0, 0]},
    "a list": [1, 2, 3],
    "a number": 7,
}


@pytest.mark.parametrize("case", INVALID_VIEWPOINTS)
def test_an_invalid_viewpoint_is_reported_in_one_sentence(case, write_model):
    path = write_model({"viewpoint": INVALID_VIEWPOINTS[case], "cameras": provenance_cameras(ring(3))})
    with pytest.raises(HyrfError, match=r"viewpoint [^\n]*$"):
        Source.read(path)


@pytest.mark.parametrize("cameras", [7, "none", [[1, 2, 3]], [[32, 32, 0, 1, 1, 1, *range(12)]], {"a": 1}])
def test_invalid_cameras_are_reported_in_one_sentence(cameras, write_model):
    with pytest.raises(HyrfError, match=r"cameras that the file keeps are not valid [^\n]*`data`$"):
        Source.read(write_model({"cameras": cameras}))


def test_an_empty_model_and_a_missing_file_are_reported_in_one_sentence(write_model, tmp_path):
    path = write_model(positions=np.zeros((0, 3)))
    with pytest.raises(HyrfError, match=r"there is no Gaussian in it[^\n]*$"):
        Source.read(path)
    with pytest.raises(HyrfError, match=r"none\.hyrf[^\n]*$"):
        Source.read(tmp_path / "none.hyrf")


def test_up_is_opposite_to_the_view_of_cameras_that_look_down_and_turn(write_model):
    # A drone flies to and fro over the plane z = 0, so that half of its pictures are upside down.
    poses = [np.eye(4) for _ in range(12)]
    for number, pose in enumerate(poses):
        pose[:3, :3] = np.diag([1.0, -1, -1]) if number % 2 else np.diag([-1.0, 1, -1])
        pose[:3, 3] = -pose[:3, :3] @ (number - 6.0, 0.0, 3.0)
    cameras = [Camera(32, 32, 30.0, 30.0, 16.0, 16.0, pose) for pose in poses]
    ring_provenance = {"cameras": provenance_cameras(cameras), "viewpoint": Viewpoint.from_cameras(cameras).to_json()}
    assert np.allclose(Source.read(write_model(ring_provenance)).up, (0, 0, 1))
    # A direction that an edit has stated is kept, unless it contradicts the cameras.
    for stated, expected in (((0.0, 0.1, 1.0), (0, 0.1, 1.0)), ((0.0, 1.0, 0.0), (0, 0, 1)), ((0, 0, -1), (0, 0, 1))):
        ring_provenance["viewpoint"]["up"] = stated
        assert np.allclose(Source.read(write_model(ring_provenance)).up, np.array(expected) / np.linalg.norm(expected))
    ring_provenance["viewpoint"] = Viewpoint.from_cameras(cameras).to_json()
    # With equal orientation the plane may as well be a wall.
    ring_provenance["cameras"] = provenance_cameras(cameras[::2])
    assert np.allclose(abs(Source.read(write_model(ring_provenance)).up), (0, 1, 0))

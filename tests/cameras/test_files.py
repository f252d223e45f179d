from __future__ import annotations

import json
import math
import os

import numpy as np
import pytest
from hypothesis import given
from made_up_cameras import cameras
from PIL import Image
from scenes import ring

from hyrfpack.cameras.files import (
    camera_from_json,
    camera_from_numbers,
    camera_to_json,
    camera_to_numbers,
    cameras_from_json,
    cameras_to_json,
)
from hyrfpack.errors import HyrfDataError
from hyrfpack.scene import Camera

POSE_ROWS = [[1.0, 0.0, 0.0, 0.5], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 4.0], [0.0, 0.0, 0.0, 1.0]]


def test_cameras_survive_json_exactly(tmp_path):
    cameras = [("a", ring(3)[1]), ("b/c", Camera(40, 30, 50.5, 51.25, 19.0, 16.0, ring(3)[2].camera_from_world))]
    (tmp_path / "cameras.json").write_text(cameras_to_json(cameras))
    for (name, camera), (read_name, read) in zip(cameras, cameras_from_json(tmp_path / "cameras.json"), strict=True):
        assert (name, camera.width, camera.height, camera.intrinsics) == (
            read_name,
            read.width,
            read.height,
            read.intrinsics,
        )
        np.testing.assert_array_equal(read.camera_from_world, camera.camera_from_world)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_cameras_may_have_the_encodings_of_windows_editors(encoding, tmp_path):
    cameras = [("a", ring(3)[1])]
    (tmp_path / "cameras.json").write_text(cameras_to_json(cameras), encoding=encoding)
    ((name, camera),) = cameras_from_json(tmp_path / "cameras.json")
    assert (name, camera) == cameras[0]


def test_a_camera_without_principal_point_or_fy_is_centred_and_square(tmp_path):
    (tmp_path / "c.json").write_text(
        json.dumps([{"width": 40, "height": 30, "fx": 25, "camera_from_world": np.eye(4).tolist()}])
    )
    ((name, camera),) = cameras_from_json(tmp_path / "c.json")
    assert (name, camera.intrinsics) == ("0000", (25.0, 25.0, 20.0, 15.0))


def test_transforms_json_gives_the_cameras_of_the_scene_reader(shared_data):
    from hyrfpack.data import load_scene

    folder = shared_data / "shiny_can_nerfstudio"
    read = dict(cameras_from_json(folder / "transforms.json"))
    frames = json.loads((folder / "transforms.json").read_text())["frames"]
    assert len(read) == len(frames)
    poses = {os.path.basename(name): camera.camera_from_world for name, camera in read.items()}
    views = load_scene(folder, layout="nerfstudio").views
    assert views
    for view in views:
        np.testing.assert_allclose(poses[os.path.basename(view.name)], view.camera.camera_from_world, atol=1e-5)


def test_transforms_json_takes_the_angle_and_intrinsics_of_one_frame(tmp_path):
    pose = np.eye(4).tolist()
    (tmp_path / "t.json").write_text(
        json.dumps(
            {
                "w": 100,
                "h": 50,
                "camera_angle_x": math.pi / 2,
                "frames": [
                    {"file_path": "images/a.png", "transform_matrix": pose},
                    {"transform_matrix": pose, "fl_x": 70, "fl_y": 71, "cx": 3, "cy": 4, "w": 60},
                ],
            }
        )
    )
    (name, first), (_, second) = cameras_from_json(tmp_path / "t.json")
    assert name == "images/a.png"
    assert first.intrinsics == pytest.approx((50, 50, 50, 25))
    np.testing.assert_array_equal(first.camera_from_world, np.diag([1.0, -1, -1, 1]))
    assert (second.width, second.intrinsics) == (60, (70, 71, 3, 4))


@pytest.mark.parametrize(
    ("shared", "own"),
    [
        ({"camera_angle_x": 1.0, "camera_angle_y": 0.5}, {}),
        ({"fl_x": 24.0}, {"camera_angle_x": 0.5}),
        ({"fl_x": 24.0, "fl_y": 25.0}, {"camera_angle_x": 0.5, "camera_angle_y": 0.6}),
        ({"camera_angle_x": 1.0}, {"fl_x": 30.0}),
        ({"fl_y": 30.0}, {}),
        ({"fl_x": 24.0, "fl_y": None, "cx": None}, {"fl_x": None}),
        ({"camera_angle_y": 0.5}, {}),
    ],
)
def test_focal_lengths_are_those_of_the_scene_reader(shared, own, tmp_path):
    from hyrfpack.data import load_scene

    (tmp_path / "images").mkdir()
    Image.new("RGB", (24, 16)).save(tmp_path / "images" / "a.png")
    Image.new("RGB", (24, 16)).save(tmp_path / "images" / "b.png")
    frames = [{"file_path": f"images/{name}.png", "transform_matrix": np.eye(4).tolist(), **own} for name in "ab"]
    content = {"w": 24, "h": 16, **shared, "frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    (_, camera), _ = cameras_from_json(tmp_path / "transforms.json")
    view = load_scene(tmp_path, test_every=0).views[0]
    assert camera.intrinsics == pytest.approx(view.camera.intrinsics)


def test_cameras_of_3dgs_training_are_converted(tmp_path):
    """3DGS stores the position and rotation of each camera; here the pose maps world to camera coordinates."""
    made = ring(5)
    items = []
    for number, camera in enumerate(made):
        inverse = np.linalg.inv(camera.camera_from_world)
        lens = {"width": camera.width, "height": camera.height, "fx": camera.fx, "fy": camera.fy}
        place = {"position": inverse[:3, 3].tolist(), "rotation": inverse[:3, :3].tolist()}
        items.append({"id": number, "img_name": f"IMG_{number}", **lens, **place})
    (tmp_path / "cameras.json").write_text(json.dumps(items))

    read = cameras_from_json(tmp_path / "cameras.json")

    assert [name for name, _ in read] == [f"IMG_{number}" for number in range(5)]
    for (_, camera), expected in zip(read, made, strict=True):
        np.testing.assert_allclose(camera.camera_from_world, expected.camera_from_world, atol=1e-12)
        assert camera.intrinsics == (expected.fx, expected.fy, expected.width / 2, expected.height / 2)


CAMERA_BY_ROTATION = {"width": 40, "height": 30, "fx": 25, "rotation": np.eye(3).tolist(), "position": [0, 0, 0]}
CAMERA_BY_POSE = {"width": 40, "height": 30, "fx": 25, "camera_from_world": np.eye(4).tolist()}


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        ("{", "not JSON"),
        ("3", "neither a list"),
        ('{"cameras": []}', "neither a list"),
        ("[]", "no camera"),
        ("[7]", "camera 0"),
        (json.dumps([CAMERA_BY_POSE, {**CAMERA_BY_POSE, "fx": -1}]), "camera 1 is not valid"),
        (json.dumps([{**CAMERA_BY_POSE, "fx": "wide"}]), "camera 0 is not valid"),
        (json.dumps([{**CAMERA_BY_POSE, "width": 0}]), "camera 0 is not valid"),
        (json.dumps([{**CAMERA_BY_POSE, "width": 10**7}]), "camera 0 is not valid"),
        (json.dumps([{**CAMERA_BY_POSE, "height": 30.5}]), "camera 0 is not valid"),
        (json.dumps([{**CAMERA_BY_POSE, "height": None}]), "camera 0 is not valid"),
        (json.dumps([{**CAMERA_BY_POSE, "cx": math.nan}]), "camera 0 is not valid"),
        (json.dumps([{**CAMERA_BY_POSE, "width": math.inf}]), "camera 0 is not valid"),
        (json.dumps([{**CAMERA_BY_POSE, "camera_from_world": [1, 2]}]), "camera 0 is not valid"),
        (
            json.dumps([{**CAMERA_BY_POSE, "camera_from_world": np.diag([1, 1, -1, 1]).tolist()}]),
            "camera 0 is not valid",
        ),
        (json.dumps([{"width": 3}]), "camera 0 has no"),
        (json.dumps([CAMERA_BY_ROTATION, {**CAMERA_BY_ROTATION, "position": [0, 0]}]), "camera 1 is not valid"),
        (json.dumps([{**CAMERA_BY_ROTATION, "position": [0, 0, math.nan]}]), "camera 0 is not valid"),
        (json.dumps([{**CAMERA_BY_ROTATION, "rotation": [[2, 0, 0], [0, 2, 0], [0, 0, 2]]}]), "camera 0 is not valid"),
        (json.dumps([{**CAMERA_BY_ROTATION, "rotation": "turned"}]), "camera 0 is not valid"),
        (json.dumps([{"rotation": np.eye(3).tolist()}]), "camera 0 has no 'position'"),
        (json.dumps({"frames": [{"transform_matrix": np.eye(4).tolist()}]}), "camera 0 has no 'w'"),
    ],
)
def test_a_broken_camera_file_is_a_clear_error(content, complaint, tmp_path):
    (tmp_path / "c.json").write_text(content)
    with pytest.raises(HyrfDataError, match=complaint):
        cameras_from_json(tmp_path / "c.json")


def test_a_missing_camera_file_is_named(tmp_path):
    with pytest.raises(HyrfDataError, match=r"none\.json"):
        cameras_from_json(tmp_path / "none.json")


# -- one camera --------------------------------------------------------------------------------------------------------


def test_the_json_of_a_camera_has_not_changed_since_earlier_versions():
    text = json.dumps(camera_to_json(Camera(800, 600, 700.0, 650.5, 400.0, 300.25, POSE_ROWS)))
    size = '"width": 800, "height": 600, "fx": 700.0, "fy": 650.5, "cx": 400.0, "cy": 300.25'
    assert text == f'{{{size}, "camera_from_world": {json.dumps(POSE_ROWS)}}}'


@given(camera=cameras())
def test_a_camera_survives_json_exactly(camera):
    assert camera_from_json(json.loads(json.dumps(camera_to_json(camera)))) == camera


@given(camera=cameras())
def test_numbers_are_not_rounded_again_by_a_round_trip(camera):
    numbers = json.loads(json.dumps(camera_to_numbers(camera)))
    back = camera_from_numbers(numbers)
    assert camera_to_numbers(back) == numbers
    np.testing.assert_allclose(back.camera_from_world, camera.camera_from_world, rtol=1e-8, atol=1e-6)
    np.testing.assert_allclose(back.intrinsics, camera.intrinsics, rtol=1e-8, atol=1e-6)
    assert (back.width, back.height) == (camera.width, camera.height)


@pytest.mark.parametrize("count", [0, 5, 17, 19])
def test_too_few_numbers_or_too_many_are_rejected(count):
    with pytest.raises(ValueError):
        camera_from_numbers([*camera_to_numbers(Camera(4, 3, 2.0, 2.0, 2.0, 1.5, POSE_ROWS)), 0.0][:count])

from __future__ import annotations

import json
import math
import os
import stat
import sys

import numpy as np
import pytest
import torch
from PIL import Image
from scenes import ball_points, camera_at, ring, small_model

from hyrfpack.cameras.files import cameras_from_json, cameras_to_json
from hyrfpack.cameras.paths import frame_viewpoint, look_at, orbit, stored_viewpoint, viewpoint_hint
from hyrfpack.errors import HyrfDataError, HyrfError
from hyrfpack.render import render
from hyrfpack.render.files import file_names, render_files, save_picture
from hyrfpack.render.video import write_video
from hyrfpack.scene import Camera


def azimuths(cameras, center=(0, 0, 0)) -> np.ndarray:
    """Degrees around the z axis."""
    offsets = np.array([camera.position for camera in cameras]) - center
    return np.degrees(np.arctan2(offsets[:, 1], offsets[:, 0]))


def ring_part(first: float, last: float, count: int = 15) -> list[Camera]:
    """Cameras on a part of a circle of radius 3 and height 1, between two azimuths in degrees."""
    angles = np.radians(np.linspace(first, last, count))
    return [camera_at((3 * math.cos(a), 3 * math.sin(a), 1)) for a in angles]


def moved(cameras, offset) -> list[Camera]:
    result = []
    for camera in cameras:
        pose = camera.camera_from_world.copy()
        pose[:3, 3] -= pose[:3, :3] @ np.asarray(offset)
        result.append(Camera(camera.width, camera.height, *camera.intrinsics, pose))
    return result


# -- the hint --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("offset", [(0, 0, 0), (1e6, -2e6, 3e5)])
def test_cameras_around_an_object_are_summed_up_by_what_they_look_at(offset):
    hint = viewpoint_hint(moved(ring(12), offset))
    np.testing.assert_allclose(hint["center"], offset, atol=1e-6)
    np.testing.assert_allclose(hint["up"], (0, 0, 1), atol=1e-9)
    assert hint["arc"] == [0.0, 360.0]
    assert (hint["width"], hint["height"], hint["intrinsics"]) == (32, 32, [32.0, 32.0, 16.0, 16.0])


def test_up_is_the_axis_that_cameras_are_level_about():
    on_a_part = [camera_at((3 * math.cos(a), 3 * math.sin(a), 2.5)) for a in np.linspace(0, 1.5, 9)]
    np.testing.assert_allclose(viewpoint_hint(on_a_part)["up"], (0, 0, 1), atol=1e-9)
    almost_above = [camera_at((1.7 * math.cos(a), 1.7 * math.sin(a), 9)) for a in np.linspace(0, 2.5, 9)]
    np.testing.assert_allclose(viewpoint_hint(almost_above)["up"], (0, 0, 1), atol=1e-9)


def test_hint_is_json():
    hint = viewpoint_hint(ring(5))
    assert json.loads(json.dumps(hint, allow_nan=False)) == hint


def test_typical_camera_is_no_outlier():
    odd = camera_at((40, 0, 30))
    assert np.linalg.norm(np.array(orbit(viewpoint_hint([odd, *ring(8)]), 1)[0].position)) < 4


@pytest.mark.parametrize(("first", "last"), [(-30, 60), (100, 250), (170, 200), (350, 480)])
def test_swing_stays_on_the_arc_that_the_photos_cover(first, last):
    cameras = ring_part(first, last)
    path = orbit(viewpoint_hint(cameras), 40)
    middle = (first + last) / 2
    seen = (azimuths(path) - middle + 180) % 360 - 180
    assert seen.min() == pytest.approx(first - middle, abs=1)
    assert seen.max() == pytest.approx(last - middle, abs=1)


def test_cameras_that_look_the_same_way_get_a_small_swing_in_front_of_them():
    cameras = [camera_at((x, -5.0, 0.0), (x, 0.0, 0.0)) for x in np.linspace(-1, 1, 9)]
    hint = viewpoint_hint(cameras)
    assert hint["center"][1] > -5
    assert hint["arc"] == [-10.0, 10.0]


def test_cameras_that_look_outwards_do_not_orbit_the_point_behind_them():
    cameras = [camera_at(camera.position, 2 * camera.position) for camera in ring(8, elevation=0.0)]
    path = orbit(viewpoint_hint(cameras), 8)
    assert all(camera.forward @ path[0].forward > 0.9 for camera in path)


@pytest.mark.parametrize("count", [1, 2])
def test_one_or_two_cameras_are_enough(count):
    path = orbit(viewpoint_hint(ring(8)[:count]), 3)
    assert all(np.isfinite(camera.camera_from_world).all() for camera in path)


def test_a_real_capture_is_orbited_among_its_cameras(shared_data):
    from hyrfpack.data import load_scene

    cameras = [view.camera for view in load_scene(shared_data / "mipnerf360_bonsai").train]
    path = orbit(viewpoint_hint(cameras), 12)
    positions = np.array([camera.position for camera in cameras])
    nearest = [np.linalg.norm(positions - camera.position, axis=1).min() for camera in path]
    assert max(nearest) < 0.3 * np.ptp(positions, axis=0).max()


# -- the orbit -------------------------------------------------------------------------------------------------------


def test_orbit_looks_at_the_centre_from_the_typical_distance_and_height():
    center = np.array([5.0, -7.0, 11.0])
    path = orbit(viewpoint_hint(moved(ring(10, radius=3, height=1), center)), 24)
    for camera in path:
        local = camera.camera_from_world @ [*center, 1]
        np.testing.assert_allclose(local[:3], (0, 0, math.sqrt(10)), atol=1e-9)
        np.testing.assert_allclose(camera.rotation @ camera.rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(camera.rotation) == pytest.approx(1)
        assert camera.position[2] == pytest.approx(12)
        assert camera.rotation[1, 2] < 0  # y points down: the horizon is upright
    steps = np.diff(np.unwrap(azimuths(path, center), period=360))
    np.testing.assert_allclose(np.abs(steps), 15, atol=1e-6)


def test_orbit_around_a_place_seen_from_straight_above_is_a_circle():
    above = camera_at((0, 0, 5), up=(0, 1, 0))
    viewpoint = {**viewpoint_hint(ring(6)), "camera_from_world": above.camera_from_world.tolist()}
    positions = np.array([camera.position for camera in orbit(viewpoint, 6)])
    assert np.ptp(positions, axis=0)[:2].min() > 1


def test_a_file_without_a_viewpoint_is_orbited_by_its_frame():
    facts = {"provenance": {}, "config": {"frame": {"center": [1.0, 2.0, 3.0], "scale": 4.0}}}
    assert stored_viewpoint(facts) == frame_viewpoint([1.0, 2.0, 3.0], 4.0)
    for camera in orbit(stored_viewpoint(facts), 5):
        assert np.linalg.norm(camera.position - (1, 2, 3)) == pytest.approx(10)
        assert camera.position[1] < 2  # looks down: up is -y
        assert camera.forward @ (camera.position - (1, 2, 3)) == pytest.approx(-10)


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
def test_a_forged_viewpoint_is_an_error_of_the_files(change):
    with pytest.raises(HyrfDataError, match="viewpoint"):
        orbit({**viewpoint_hint(ring(3)), **change}, 2)


def test_look_at_takes_a_view_along_up():
    pose = look_at(np.array([0.0, 0.0, 2.0]), np.zeros(3), np.array([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(pose @ [0, 0, 0, 1], [0, 0, 2, 1], atol=1e-12)


# -- camera files ----------------------------------------------------------------------------------------------------


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


GOOD = {"width": 40, "height": 30, "fx": 25, "camera_from_world": np.eye(4).tolist()}


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        ("{", "not JSON"),
        ("3", "neither a list"),
        ('{"cameras": []}', "neither a list"),
        ("[]", "no camera"),
        ("[7]", "camera 0"),
        (json.dumps([GOOD, {**GOOD, "fx": -1}]), "camera 1 makes no sense"),
        (json.dumps([{**GOOD, "fx": "wide"}]), "camera 0 makes no sense"),
        (json.dumps([{**GOOD, "width": 0}]), "camera 0 makes no sense"),
        (json.dumps([{**GOOD, "width": 10**7}]), "camera 0 makes no sense"),
        (json.dumps([{**GOOD, "height": 30.5}]), "camera 0 makes no sense"),
        (json.dumps([{**GOOD, "height": None}]), "camera 0 makes no sense"),
        (json.dumps([{**GOOD, "cx": math.nan}]), "camera 0 makes no sense"),
        (json.dumps([{**GOOD, "width": math.inf}]), "camera 0 makes no sense"),
        (json.dumps([{**GOOD, "camera_from_world": [1, 2]}]), "camera 0 makes no sense"),
        (json.dumps([{**GOOD, "camera_from_world": np.diag([1, 1, -1, 1]).tolist()}]), "camera 0 makes no sense"),
        (json.dumps([{"width": 3}]), "camera 0 has no"),
        (json.dumps({"frames": [{"transform_matrix": np.eye(4).tolist()}]}), "camera 0 has no 'w'"),
    ],
)
def test_a_broken_camera_file_is_one_sentence(content, complaint, tmp_path):
    (tmp_path / "c.json").write_text(content)
    with pytest.raises(HyrfDataError, match=complaint):
        cameras_from_json(tmp_path / "c.json")


def test_a_missing_camera_file_is_named(tmp_path):
    with pytest.raises(HyrfDataError, match=r"none\.json"):
        cameras_from_json(tmp_path / "none.json")


# -- files -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("names", "files"),
    [
        (["b.JPG", "left/0001.png"], ["b", "left/0001"]),
        (["a.jpg", "a.png"], ["a.jpg", "a.png"]),
        (["frame.0001", "frame.0002"], ["frame.0001", "frame.0002"]),
        (["../../etc/passwd", "/abs/x.png", "..\\y.png"], ["etc/passwd", "abs/x", "y"]),
        (["", ".."], ["0000_view", "0001_view"]),
        (["same", "same"], ["0000_same", "0001_same"]),
        (["a\0b:c"], ["a_b_c"]),
    ],
)
def test_pictures_are_named_after_photos_and_stay_in_the_folder(names, files):
    assert file_names(names) == files


def test_rendered_files_hold_the_rounded_render_and_exact_depth(tmp_path):
    points, _ = ball_points(60)
    model, camera = small_model(points, scale_logits=-2.0), ring(1)[0]
    (path,) = render_files(model, [("deep/down/a.jpg", camera)], tmp_path / "out", depth=True)
    with torch.no_grad():
        expected = render(model, camera, depth=True)
    assert path == tmp_path / "out" / "deep" / "down" / "a.png"
    saved = np.asarray(Image.open(path)).astype(np.float64)
    np.testing.assert_allclose(saved, 255 * expected.rgb.clamp(0, 1).numpy(), atol=0.501)
    np.testing.assert_array_equal(np.asarray(Image.open(path.with_suffix(".depth.tiff"))), expected.depth.numpy())
    assert expected.depth.max() > 0


def test_a_folder_that_cannot_be_made_is_one_sentence(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(HyrfError, match="cannot be made"):
        save_picture(tmp_path / "file" / "a.png", Image.new("RGB", (2, 2)))


# -- video -----------------------------------------------------------------------------------------------------------


def stand_in_ffmpeg(folder, monkeypatch, body: str) -> None:
    """Put a Python script named ffmpeg first on the PATH."""
    script = folder / "bin" / "ffmpeg"
    script.parent.mkdir()
    script.write_text(f"#!{sys.executable}\nimport sys\n{body}\n")
    script.chmod(script.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("PATH", f"{script.parent}{os.pathsep}{os.environ['PATH']}")


@pytest.mark.skipif(os.name == "nt", reason="needs executable scripts")
def test_video_gets_all_frames_in_order(tmp_path, monkeypatch):
    stand_in_ffmpeg(tmp_path, monkeypatch, "open(sys.argv[-1], 'wb').write(sys.stdin.buffer.read())")
    frames = [tmp_path / name for name in ("b.png", "a.png")]
    for frame in frames:
        frame.write_bytes(frame.name.encode() * 40_000)
    write_video(frames, tmp_path / "video.mp4")
    assert (tmp_path / "video.mp4").read_bytes() == b"b.png" * 40_000 + b"a.png" * 40_000
    assert not list(tmp_path.glob(".*"))


@pytest.mark.skipif(os.name == "nt", reason="needs executable scripts")
def test_failing_ffmpeg_is_quoted_and_leaves_the_old_video(tmp_path, monkeypatch):
    body = "open(sys.argv[-1], 'wb').write(b'half')\nprint('no such encoder', file=sys.stderr)\nsys.exit(1)"
    stand_in_ffmpeg(tmp_path, monkeypatch, body)
    (tmp_path / "frame.png").write_bytes(bytes(3_000_000))
    (tmp_path / "video.mp4").write_bytes(b"old")
    with pytest.raises(HyrfError, match="no such encoder"):
        write_video([tmp_path / "frame.png"], tmp_path / "video.mp4")
    assert (tmp_path / "video.mp4").read_bytes() == b"old"
    assert not list(tmp_path.glob(".*"))


def test_video_without_ffmpeg_says_so(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(HyrfError, match="no ffmpeg program"):
        write_video([], tmp_path / "video.mp4")

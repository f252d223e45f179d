from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
from scenes import ball_scene, camera_at, look_at, view_of

from hyrfpack.cameras.files import camera_from_json, camera_to_json
from hyrfpack.scene import Camera, Picture, Scene, View


def test_camera_position_is_the_centre_of_projection():
    camera = camera_at((3.0, -2.0, 1.0), (0.5, 0.5, 0.0))
    homogeneous = camera.camera_from_world @ np.append(camera.position, 1)
    np.testing.assert_allclose(camera.position, (3, -2, 1), atol=1e-12)
    np.testing.assert_allclose(homogeneous[:3], 0, atol=1e-12)


def test_camera_forward_points_at_its_target():
    camera = camera_at((0.0, -5.0, 0.0), (0.0, 0.0, 0.0))
    np.testing.assert_allclose(camera.forward, (0, 1, 0), atol=1e-12)


def test_camera_intrinsics_have_the_order_fx_fy_cx_cy():
    assert Camera(8, 6, 1.0, 2.0, 3.0, 4.0, np.eye(4)).intrinsics == (1.0, 2.0, 3.0, 4.0)


@pytest.mark.parametrize("size", [(16.5, 16), (16, 16.0), ("16", 16), (None, 16)], ids=str)
def test_a_picture_size_that_is_no_integer_is_rejected(size):
    with pytest.raises(ValueError, match="both must be integers"):
        Camera(*size, 1.0, 2.0, 3.0, 4.0, np.eye(4))


def test_a_camera_of_numpy_numbers_is_written_as_json():
    camera = Camera(np.int64(160), np.uint8(250), np.float32(1.5), 2, np.float64(3), np.float16(4), np.eye(4))
    assert camera.height * camera.height == 62500
    assert camera_from_json(json.loads(json.dumps(camera_to_json(camera)))) == camera


def test_project_agrees_with_the_pinhole_equation_and_marks_points_behind():
    camera = Camera(8, 6, 10.0, 12.0, 3.5, 2.5, look_at((0, -3.0, 0), (0, 0, 0)))  # looks along y, its x axis is x
    x, y, z = camera.project(np.array([[0.3, 0.0, 0.0], [0.0, 2.0, 0.5], [1.0, -3.0, 1.0], [0.0, -4.0, 0.0]]))
    np.testing.assert_allclose(z, [3.0, 5.0, 0.0, -1.0], atol=1e-12)
    np.testing.assert_allclose(x[:2], [3.5 + 10 * 0.3 / 3, 3.5])
    np.testing.assert_allclose(y[:2], [2.5, 2.5 - 12 * 0.5 / 5])


def test_points_on_the_left_and_upper_border_are_in_the_picture_and_those_on_the_others_are_not():
    camera = Camera(8, 6, 5.0, 5.0, 4.0, 3.0, np.eye(4))
    x = np.array([0.0, 8.0, 4.0, 4.0, -1e-9, 4.0, np.nan])
    y = np.array([0.0, 3.0, 6.0, 3.0, 3.0, 3.0, 3.0])
    z = np.array([1.0, 1.0, 1.0, -1.0, 1.0, 1e-9, 1.0])
    assert camera.in_picture(x, y, z).tolist() == [True, False, False, False, False, True, False]


def test_unproject_inverts_project():
    camera = Camera(8, 6, 10.0, 12.0, 3.5, 2.5, look_at((0.4, -3.0, 1.0), (0, 0, 0)))
    points = np.random.default_rng(0).uniform(-1, 1, (20, 3))
    np.testing.assert_allclose(camera.unproject(*camera.project(points)), points, atol=1e-12)


def test_look_at_is_a_rotation_with_y_down():
    """The tests' own helper needs a test, because all others rely on it."""
    pose = look_at((4.0, 1.0, 2.0), (0, 0, 0))
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.isclose(np.linalg.det(pose[:3, :3]), 1)
    above = pose[:3, :3] @ (0, 0, 0.1) + pose[:3, 3]
    assert above[1] < 0 < above[2]


def test_an_opaque_picture_ignores_the_background():
    rgb = np.arange(24, dtype=np.uint8).reshape(2, 4, 3)
    composite = Picture(rgb).composite(np.array([1.0, 0, 0]))
    assert composite.dtype == np.float32
    np.testing.assert_allclose(composite, rgb / 255.0, atol=1e-7)


def test_a_straight_alpha_picture_is_laid_over_the_background():
    rgb = np.full((1, 3, 3), 200, np.uint8)
    alpha = np.array([[0, 51, 255]], np.uint8)
    background = np.array([0.25, 0.5, 1.0])

    composite = Picture(rgb, alpha).composite(background)

    expected = [alpha_ * 200 / 255 + (1 - alpha_) * background for alpha_ in (0, 0.2, 1)]
    np.testing.assert_allclose(composite[0], expected, atol=1e-6)


def test_a_picture_with_alpha_is_composited_over_black_by_default():
    picture = Picture(np.full((1, 1, 3), 255, np.uint8), np.full((1, 1), 51, np.uint8))
    np.testing.assert_allclose(picture.composite(), 0.2, atol=1e-6)


def test_composite_does_not_change_the_stored_picture():
    picture = Picture(np.full((2, 2, 3), 100, np.uint8), np.full((2, 2), 128, np.uint8))
    picture.composite(np.ones(3))
    assert (picture.rgb == 100).all() and (picture.alpha == 128).all()


def test_picture_counts_all_its_bytes():
    rgb, alpha, mask = np.zeros((4, 5, 3), np.uint8), np.zeros((4, 5), np.uint8), np.ones((4, 5), bool)
    assert [Picture(rgb).nbytes, Picture(rgb, alpha).nbytes, Picture(rgb, alpha, mask).nbytes] == [60, 80, 100]


def test_scene_views_are_both_splits_sorted_by_name():
    def named(name):
        return view_of(name, camera_at((3, 0, 0)), None)

    scene = Scene("x", "colmap", [named("b"), named("d")], [named("a"), named("c")], np.zeros((0, 3)), np.zeros((0, 3)))
    assert [view.name for view in scene.views] == ["a", "b", "c", "d"]


@pytest.mark.parametrize("rows", [[-1, 0], [0, 100]], ids=str)
def test_tracks_of_missing_points_are_rejected(rows):
    scene = ball_scene(2, points=100)
    with pytest.raises(ValueError, match=r"tracks of 000\.png: rows -?\d+ to \d+ of 100 points"):
        dataclasses.replace(scene, tracks={"000.png": np.array(rows)})
    with pytest.raises(ValueError, match=r"tracks of 000\.png: rows are \(M,\) int64"):
        dataclasses.replace(scene, tracks={"000.png": np.array(rows, np.float64)})


# -- poses -----------------------------------------------------------------------------------------------------------


def camera_with_pose(pose) -> Camera:
    return Camera(8, 6, 1.0, 2.0, 3.0, 4.0, pose)


@pytest.mark.parametrize(
    ("pose", "says"),
    [
        (np.diag([2.0, 2, 2, 1]), "not rigid"),
        (np.diag([1.0, 1, 1, 2]), "not rigid"),
        (np.diag([1.0, 1, 1, 1]) + np.eye(4, k=1), "not rigid"),
        (np.diag([1.0, 1, 1.002, 1]), "not rigid"),
        (np.diag([1e200, 1, 1, 1]), "not finite"),
        (np.diag([1.0, 1, -1, 1]), "mirrors"),
        (np.full((4, 4), np.nan), "not finite"),
        (np.eye(3), r"shape \(3, 3\)"),
        ([[1, 2], [3]], "camera_from_world"),
        ("pose", "camera_from_world"),
        (None, "camera_from_world"),
        ([[{}] * 4] * 4, "camera_from_world"),
    ],
    ids=str,
)
def test_a_pose_that_is_not_rigid_is_rejected(pose, says):
    with pytest.raises(ValueError, match=says):
        camera_with_pose(pose)


def test_a_rounded_pose_is_accepted():
    pose = look_at((4.0, 1.0, 2.0), (0, 0, 0)).round(4)
    np.testing.assert_array_equal(camera_with_pose(pose).camera_from_world, pose)


@pytest.mark.parametrize("rows", [3, 4])
def test_a_camera_copies_its_pose_from_lists_and_arrays(rows):
    pose = look_at((4.0, 1.0, 2.0), (0, 0, 0))
    camera = camera_with_pose(pose[:rows].tolist())
    assert camera.camera_from_world.dtype == np.float64
    np.testing.assert_array_equal(camera.camera_from_world, pose)
    np.testing.assert_allclose(camera.position, (4, 1, 2), atol=1e-12)
    kept = camera_with_pose(pose)
    pose[0, 3] += 1
    assert kept == camera


# -- equality and what is printed ------------------------------------------------------------------------------------


def test_cameras_are_equal_if_all_their_numbers_are():
    camera, other = camera_with_pose(np.eye(4)), camera_with_pose(np.where(np.eye(4) == 0, -0.0, 1.0))
    assert camera == other and hash(camera) == hash(other) and len({camera, other}) == 1
    moved = np.eye(4)
    moved[0, 3] = 1e-9
    assert (
        camera != camera_with_pose(moved)
        and camera != Camera(8, 6, 1.0, 2.0, 3.0, 5.0, np.eye(4))
        and camera != "camera"
    )


def test_views_of_one_photo_are_equal_and_can_be_looked_up():
    def load():
        return Picture(np.zeros((6, 8, 3), np.uint8))

    view, same = (View("a.png", camera_with_pose(np.eye(4)), load) for _ in range(2))
    others = [
        View("b.png", camera_with_pose(np.eye(4)), load),
        View("a.png", camera_with_pose(np.eye(4)), lambda: None),
    ]
    assert view == same and hash(view) == hash(same) and others.count(view) == 0
    assert [*others, same].index(view) == 2


def test_pictures_and_scenes_are_equal_to_themselves_alone():
    scene, other = ball_scene(3), ball_scene(3)
    picture = scene.train[0].load()
    assert scene == scene and scene != other and len({scene, other}) == 2
    assert picture == picture and picture != Picture(picture.rgb) and hash(picture)


def test_a_scene_is_printed_on_one_line():
    assert repr(ball_scene(3)) == "Scene('balls', 'colmap': 3 views to train on, 0 held out, 100 points)"


def test_a_scene_holds_out_the_views_that_are_named_and_trains_on_the_others():
    scene = ball_scene(5)
    names = [view.name for view in scene.views]
    split = scene.with_held_out([names[3]])
    assert [view.name for view in split.test] == [names[3]]
    assert [view.name for view in split.train] == [name for name in names if name != names[3]]
    assert split.with_held_out([]).test == []


@pytest.mark.parametrize("names, words", [(["nobody.jpg"], "no photo is named nobody.jpg"), (None, "none is left")])
def test_holding_out_a_missing_view_or_all_views_is_rejected(names, words):
    scene = ball_scene(3)
    with pytest.raises(ValueError, match=words):
        scene.with_held_out([view.name for view in scene.views] if names is None else names)

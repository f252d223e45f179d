from __future__ import annotations

import numpy as np
from scenes import camera_at, look_at, view_of

from hyrfpack.scene import Camera, Picture, Scene


def test_camera_position_is_the_centre_of_projection():
    camera = camera_at((3.0, -2.0, 1.0), (0.5, 0.5, 0.0))
    homogeneous = camera.camera_from_world @ np.append(camera.position, 1)
    np.testing.assert_allclose(camera.position, (3, -2, 1), atol=1e-12)
    np.testing.assert_allclose(homogeneous[:3], 0, atol=1e-12)


def test_camera_forward_points_at_what_is_ahead():
    camera = camera_at((0.0, -5.0, 0.0), (0.0, 0.0, 0.0))
    np.testing.assert_allclose(camera.forward, (0, 1, 0), atol=1e-12)


def test_camera_gives_intrinsics_in_the_order_of_the_kernels():
    assert Camera(8, 6, 1.0, 2.0, 3.0, 4.0, np.eye(4)).intrinsics == (1.0, 2.0, 3.0, 4.0)


def test_look_at_is_a_rotation_with_y_down():
    """The tests' own helper: wrong here, wrong everywhere."""
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


def test_without_a_background_coverage_fades_to_black():
    picture = Picture(np.full((1, 1, 3), 255, np.uint8), np.full((1, 1), 51, np.uint8))
    np.testing.assert_allclose(picture.composite(), 0.2, atol=1e-6)


def test_composite_leaves_the_stored_picture_alone():
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

from __future__ import annotations

import shutil

import numpy as np
import pytest
from exported_sets import WRITERS_BY_LAYOUT, PhotoCamera

from hyrfpack.data import load_scene
from hyrfpack.errors import HyrfDataError


@pytest.fixture
def folder(tmp_path, pictures):
    """A set of three 32 x 24 photos with poses, the second of them at (1, 2, 3)."""
    pictures(tmp_path / "images", ["a.png", "b.png", "c.png"])
    pose = np.eye(4)
    pose[:3, 3] = -1, -2, -3
    cameras = [PhotoCamera(name, 32, 24, 30.0, 30.0, 16.0, 12.0, pose if name == "b" else np.eye(4)) for name in "abc"]
    WRITERS_BY_LAYOUT["llff"](tmp_path, cameras, np.zeros((0, 3)), np.zeros((0, 3)))
    return tmp_path


def edit_poses(root, change) -> None:
    table = np.load(root / "poses_bounds.npy")
    np.save(root / "poses_bounds.npy", change(table))


def test_a_camera_without_rotation_has_the_documented_row(folder):
    """Down, right and backwards are -y, x and z of OpenGL's axes: the camera looks along the world's -z with y up."""
    row = [0, 1, 0, 5, 24, -1, 0, 0, 6, 32, 0, 0, 1, 7, 30, 1, 10]
    edit_poses(folder, lambda table: np.array([row] * 3, np.float64))

    camera = load_scene(folder).views[0].camera

    np.testing.assert_allclose(camera.rotation, np.diag([1.0, -1, -1]), atol=1e-12)
    np.testing.assert_allclose(camera.position, (5, 6, 7))
    assert camera.intrinsics == (30, 30, 16, 12)


def test_poses_belong_to_the_photos_sorted_by_name(folder):
    np.testing.assert_allclose(load_scene(folder).views[1].camera.position, (1, 2, 3))


def test_the_largest_copies_replace_missing_photos(folder, pictures):
    (folder / "images").rename(folder / "images_8")
    pictures(folder / "images_4", ["a.png", "b.png", "c.png"], size=(16, 12))

    scene = load_scene(folder)

    assert "photos are read from images_4" in scene.notes
    assert scene.views[0].camera.width == 16


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_tables_of_single_and_double_precision_are_read(folder, kind):
    edit_poses(folder, lambda table: table.astype(kind))

    assert len(load_scene(folder).views) == 3


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (lambda root: edit_poses(root, lambda table: table[:2]), "the poses of 2 photos, but images holds 3"),
        (lambda root: edit_poses(root, lambda table: table[:, :16]), "17 numbers"),
        (lambda root: edit_poses(root, lambda table: table.astype(object)), "not a table that can be read"),
        (lambda root: edit_poses(root, lambda table: table.astype(complex)), "17 numbers"),
        (lambda root: edit_poses(root, lambda table: table[:0]), "the table is empty"),
        (lambda root: edit_poses(root, lambda table: table * np.nan), "not finite"),
        (lambda root: edit_poses(root, lambda table: table * 2), "not rigid"),
        (lambda root: (root / "poses_bounds.npy").write_bytes(b""), "not a table"),
        (lambda root: (root / "poses_bounds.npy").write_bytes(b"\x93NUMPY\x01\x00v\x00{'descr'"), "not a table"),
        (lambda root: shutil.rmtree(root / "images"), "the poses of 3 photos, but .* holds 0"),
    ],
)
def test_a_broken_set_is_a_clear_error(folder, damage, says):
    damage(folder)

    with pytest.raises(HyrfDataError, match=says) as caught:
        load_scene(folder)

    assert "\n" not in str(caught.value) and str(folder) in str(caught.value)


def test_a_forged_shape_allocates_no_memory(folder):
    data = (folder / "poses_bounds.npy").read_bytes()
    (folder / "poses_bounds.npy").write_bytes(
        data.replace(b"(3, 17), }", b"(3000000000000, 17), }").replace(b"            \n", b"\n")
    )

    with pytest.raises(HyrfDataError, match="not a table that can be read"):
        load_scene(folder)

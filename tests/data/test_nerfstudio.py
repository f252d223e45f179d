from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, given
from hypothesis import strategies as st
from PIL import Image
from property_tests import examples

from hyrfpack.data import load_scene
from hyrfpack.errors import HyrfDataError


def edit_frame(root: Path, index: int, **entries) -> None:
    content = json.loads((root / "transforms.json").read_text())
    content["frames"][index] |= entries
    (root / "transforms.json").write_text(json.dumps(content))


def test_poses_intrinsics_and_names_are_read(nerfstudio_folder, opengl_frames):
    root = nerfstudio_folder(9)
    _, poses = opengl_frames([str(index) for index in range(9)])

    scene = load_scene(root)

    assert scene.layout == "nerfstudio" and scene.notes == []
    assert [view.name for view in scene.test] == ["000.png", "008.png"]
    for view, pose in zip(scene.views, poses, strict=True):
        np.testing.assert_allclose(view.camera.camera_from_world, pose, atol=1e-12)
        assert view.camera.intrinsics == (30.0, 31.0, 17.0, 11.0)


def test_intrinsics_of_a_frame_override_global_ones(nerfstudio_folder):
    root = nerfstudio_folder()
    edit_frame(root, 2, fl_x=40.0, cy=12.5)

    views = load_scene(root).views

    assert views[2].camera.intrinsics == (40.0, 31.0, 17.0, 12.5)
    assert views[1].camera.intrinsics == (30.0, 31.0, 17.0, 11.0)


@pytest.mark.parametrize(
    ("entries", "focal_lengths"),
    [
        ({"camera_angle_x": 1.0}, (16 / math.tan(0.5),) * 2),
        ({"camera_angle_x": 1.0, "camera_angle_y": 0.8}, (16 / math.tan(0.5), 12 / math.tan(0.4))),
        ({"camera_angle_y": 0.8}, (12 / math.tan(0.4),) * 2),
        ({"camera_angle_x": 1.0, "fl_y": 40.0}, (16 / math.tan(0.5), 40.0)),
        ({"camera_angle_x": 1.0, "fl_x": 40.0}, (40.0, 40.0)),
    ],
)
def test_the_field_of_view_of_a_frame_overrides_a_global_focal_length(nerfstudio_folder, entries, focal_lengths):
    root = nerfstudio_folder()
    edit_frame(root, 2, **entries)

    views = load_scene(root).views

    np.testing.assert_allclose(views[2].camera.intrinsics[:2], focal_lengths)
    assert views[1].camera.intrinsics[:2] == (30.0, 31.0)


@pytest.mark.parametrize("images", ["images_9", "x" * 300])
def test_a_missing_photo_folder_is_a_clear_error(nerfstudio_folder, images):
    with pytest.raises(HyrfDataError, match="no photo folder"):
        load_scene(nerfstudio_folder(), images=images)


@pytest.mark.parametrize("key", ["camera_angle_x", "camera_angle_y"])
def test_an_impossible_field_of_view_names_its_key(nerfstudio_folder, key):
    root = nerfstudio_folder(fl_x=None, fl_y=None, **{"camera_angle_x": 1.0, "camera_angle_y": 1.0, key: 4.0})
    with pytest.raises(HyrfDataError, match=f"4 radians is outside .*; correct '{key}'"):
        load_scene(root)


@pytest.mark.parametrize(("coefficients", "is_resampled"), [({}, False), ({"k1": 0.1}, True)])
def test_views_of_distorted_photos_are_marked_as_resampled(nerfstudio_folder, coefficients, is_resampled):
    assert {view.is_resampled for view in load_scene(nerfstudio_folder(**coefficients)).views} == {is_resampled}


def test_photos_that_are_turned_upright_are_marked_as_resampled(nerfstudio_folder):
    root, exif = nerfstudio_folder(), Image.Exif()
    exif[0x0112] = 6
    for path in (root / "images").iterdir():
        with Image.open(path) as image:
            image.convert("RGB").transpose(Image.Transpose.ROTATE_90).save(path, exif=exif)
    assert all(view.is_resampled for view in load_scene(root).views)


def test_the_field_of_view_replaces_a_missing_focal_length(nerfstudio_folder):
    root = nerfstudio_folder(fl_x=None, fl_y=None, cx=None, cy=None, w=None, h=None, camera_angle_x=1.0)

    focal = 16 / math.tan(0.5)

    np.testing.assert_allclose(load_scene(root).views[0].camera.intrinsics, (focal, focal, 16, 12))


@pytest.mark.parametrize(
    ("entries", "model", "coefficients"),
    [
        ({"k1": 0.1, "k2": 0.02, "p1": 0.003, "p2": 0.004}, "brown", (0.1, 0.02, 0.003, 0.004, 0, 0, 0, 0)),
        ({"camera_model": "OPENCV", "k1": 0.1, "k3": 0.05}, "brown", (0.1, 0, 0, 0, 0.05, 0, 0, 0)),
        ({"camera_model": "FULL_OPENCV", "k1": 0.1, "k4": 0.2}, "brown", (0.1, 0, 0, 0, 0, 0.2, 0, 0)),
        ({"camera_model": "OPENCV_FISHEYE", "k1": 0.1, "k4": 0.05}, "fisheye", (0.1, 0, 0, 0.05)),
        ({"is_fisheye": True, "k2": 0.1}, "fisheye", (0, 0.1, 0, 0)),
        ({"camera_model": "RADIAL_FISHEYE", "k1": 0.1, "k2": 0.2}, "fisheye", (0.1, 0.2, 0, 0)),
        ({"camera_model": "PINHOLE", "k1": 0.1}, "pinhole", ()),
    ],
)
def test_camera_models_and_coefficients_are_read(nerfstudio_folder, entries, model, coefficients):
    lens = load_scene(nerfstudio_folder(**entries)).views[0].load.lens

    assert (lens.model, lens.coefficients) == (model, coefficients)


@pytest.mark.parametrize(("lowest", "has_alpha"), [(255, False), (254, True)])
def test_completely_opaque_alpha_is_not_read_as_coverage(nerfstudio_folder, lowest, has_alpha):
    root = nerfstudio_folder(9)
    for number, path in enumerate(sorted((root / "images").iterdir())):
        alpha = np.full((24, 32), 255 if number < 8 else lowest, np.uint8)
        Image.fromarray(np.dstack((np.asarray(Image.open(path)), alpha))).save(path)

    assert load_scene(root).has_alpha is has_alpha


def test_frames_without_a_file_are_skipped_and_counted(nerfstudio_folder):
    root = nerfstudio_folder(5)
    (root / "images" / "003.png").unlink()

    scene = load_scene(root)

    assert len(scene.views) == 4
    assert any("1 of 5 photos" in note for note in scene.notes)


def test_the_split_of_the_set_is_used_and_unlisted_photos_are_dropped(nerfstudio_folder):
    root = nerfstudio_folder(
        5,
        train_filenames=["images/004.png", "images/001.png"],
        val_filenames=["images/002.png"],
        test_filenames=["images/003.png"],
    )

    scene = load_scene(root)

    assert [view.name for view in scene.train] == ["001.png", "004.png"]
    assert [view.name for view in scene.test] == ["003.png"]
    note = "2 of 5 photos are not used: they are neither in train_filenames nor in test_filenames of transforms.json"
    assert note in scene.notes


def test_a_split_of_all_photos_has_no_note(nerfstudio_folder):
    names = [f"images/{number:03d}.png" for number in range(5)]
    scene = load_scene(nerfstudio_folder(5, train_filenames=names[:4], val_filenames=names[4:]))
    assert len(scene.train) == 4 and not any("not used" in note for note in scene.notes)


@pytest.mark.parametrize("encoding", ["ascii", "binary"])
def test_points_and_colours_of_a_ply_file_are_read(nerfstudio_folder, encoding):
    root = nerfstudio_folder(ply_file_path="points.ply")
    points = np.random.default_rng(0).normal(size=(7, 3)).astype(np.float32)
    colors = np.random.default_rng(1).integers(0, 256, (7, 3), dtype=np.uint8)
    (root / "points.ply").write_bytes(trimesh.PointCloud(points, colors).export(file_type="ply", encoding=encoding))

    scene = load_scene(root)

    np.testing.assert_allclose(scene.points, points, atol=1e-6)
    np.testing.assert_allclose(scene.point_colors, colors / 255, atol=1e-6)


def test_points_without_colours_are_grey_and_bad_ones_are_dropped(nerfstudio_folder):
    root = nerfstudio_folder(ply_file_path="points.ply")
    (root / "points.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
        "0 1 2\nnan 0 0\n3 4 5\n"
    )

    scene = load_scene(root)

    np.testing.assert_array_equal(scene.points, [[0, 1, 2], [3, 4, 5]])
    np.testing.assert_array_equal(scene.point_colors, np.full((2, 3), 0.5))
    assert any("1 of 3 points" in note for note in scene.notes)


def test_mask_paths_are_used(nerfstudio_folder):
    root = nerfstudio_folder()
    mask = np.zeros((24, 32), np.uint8)
    mask[:, 10:] = 255
    (root / "m").mkdir()
    Image.fromarray(mask).save(root / "m" / "first.png")
    edit_frame(root, 0, mask_path="m/first.png")

    views = load_scene(root).views

    np.testing.assert_array_equal(views[0].load().mask, mask > 0)
    assert views[1].load().mask is None


@pytest.mark.parametrize("folder", ["masks", "masks_2"])
def test_masks_of_full_size_are_used_for_smaller_pictures(nerfstudio_folder, pictures, folder):
    root = nerfstudio_folder()
    pictures(root / "images_2", [f"{index:03d}.png" for index in range(4)], size=(16, 12))
    mask = np.zeros((24, 32), np.uint8)
    mask[:, 10:] = 255
    (root / folder).mkdir()
    Image.fromarray(mask).save(root / folder / "001.png")

    views = load_scene(root, images="images_2").views

    np.testing.assert_array_equal(views[1].load().mask, mask[::2, ::2] > 0)
    assert views[0].load().mask is None


@pytest.mark.parametrize("angle", [None, 0.8])
def test_focal_lengths_of_an_unknown_width_are_refused_for_smaller_pictures(nerfstudio_folder, pictures, angle):
    root = nerfstudio_folder()
    pictures(root / "images_2", [f"{index:03d}.png" for index in range(4)], size=(16, 12))
    _edit_transforms(root, w=None, h=None, camera_angle_x=angle)
    with pytest.raises(HyrfDataError, match="there is no 'w' and 'h', so that focal lengths cannot be scaled"):
        load_scene(root, images="images_2")
    if angle:
        _edit_transforms(root, fl_x=None, fl_y=None, cx=None, cy=None)
        assert load_scene(root, images="images_2").views[0].camera.fx == pytest.approx(8 / np.tan(angle / 2))


def test_smaller_pictures_scale_the_intrinsics(nerfstudio_folder, pictures):
    root = nerfstudio_folder()
    pictures(root / "images_2", [f"{index:03d}.png" for index in range(4)], size=(16, 12))

    assert load_scene(root, images="images_2").views[0].camera.intrinsics == (15.0, 15.5, 8.5, 5.5)


def _write_truncated_ply(root: Path) -> None:
    header = (
        "ply\nformat ascii 1.0\nelement vertex 5\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    )
    (root / "points.ply").write_text(header + "0 1 2\n3 4 5\n")
    _edit_transforms(root, ply_file_path="points.ply")


def _edit_transforms(root: Path, **entries) -> None:
    content = json.loads((root / "transforms.json").read_text()) | entries
    (root / "transforms.json").write_text(json.dumps(content))


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (lambda root: _edit_transforms(root, fl_x=None, fl_y=None), "focal length"),
        (lambda root: _edit_transforms(root, fl_x="long"), "fl_x"),
        (lambda root: _edit_transforms(root, fl_x=-3.0), "intrinsics"),
        (lambda root: _edit_transforms(root, cx=float("inf")), "cx"),
        (lambda root: _edit_transforms(root, w=640, h=100), "640 x 100"),
        (lambda root: _edit_transforms(root, camera_model="EQUIRECTANGULAR"), "twice as wide as high"),
        (lambda root: _edit_transforms(root, camera_model="FISHEYE624"), "FISHEYE624"),
        (lambda root: _edit_transforms(root, k4=0.1), "k4"),
        (lambda root: _edit_transforms(root, ply_file_path="gone.ply"), "gone.ply"),
        (lambda root: _edit_transforms(root, train_filenames=3), "train_filenames"),
        (_write_truncated_ply, "points.ply: .* ends before the 5 rows of its element 'vertex'"),
        (
            lambda root: (root / "p.ply").write_bytes(b"ply\n") and _edit_transforms(root, ply_file_path="p.ply"),
            "p.ply",
        ),
        (lambda root: edit_frame(root, 1, mask_path="gone.png"), "gone.png"),
        (lambda root: edit_frame(root, 1, transform_matrix=[[float("nan")] * 4] * 4), "001.png"),
        (lambda root: edit_frame(root, 1, transform_matrix=[[10**400] * 4] * 4), "transform_matrix"),
        (lambda root: edit_frame(root, 1, file_path="images/000.png"), "listed twice"),
        (lambda root: (root / "images" / "001.png").write_bytes(b""), "001.png"),
        (lambda root: [file.unlink() for file in (root / "images").iterdir()], "none of the [0-9] photos that"),
        (lambda root: (root / "transforms.json").write_text("[" * 100_000), "JSON"),
        (lambda root: (root / "transforms.json").write_bytes(b"\xff\xfe{"), "JSON"),
        (lambda root: (root / "transforms.json").write_text("[]"), "not a JSON object"),
    ],
)
def test_a_broken_set_is_a_clear_error(nerfstudio_folder, damage, says):
    root = nerfstudio_folder()
    damage(root)

    with pytest.raises(HyrfDataError, match=says) as caught:
        load_scene(root)

    assert "\n" not in str(caught.value) and str(root) in str(caught.value)


_JSON_VALUES = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.floats(),
    st.text(max_size=8),
    st.lists(st.floats(), max_size=5),
    st.dictionaries(st.text(max_size=3), st.integers(), max_size=2),
    st.sampled_from([[], {}, "a\0b", "../" * 50, "x" * 5000, 10**400, [[1.0] * 4] * 4]),
)
_TOP_KEYS = ["frames", "fl_x", "fl_y", "cx", "w", "h", "k1", "k4", "camera_model", "is_fisheye", "ply_file_path"]
_FRAME_KEYS = ["file_path", "transform_matrix", "mask_path", "fl_x", "w", "k2", "camera_model"]


@examples(60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    top=st.dictionaries(st.sampled_from([*_TOP_KEYS, "train_filenames", "test_filenames"]), _JSON_VALUES, max_size=2),
    frame=st.dictionaries(st.sampled_from(_FRAME_KEYS), _JSON_VALUES, max_size=2),
    cut=st.one_of(st.none(), st.integers(0, 3000)),
)
def test_mutated_transforms_raise_only_data_errors(nerfstudio_folder, top, frame, cut):
    root = nerfstudio_folder(3)
    edit_frame(root, 1, **frame)
    _edit_transforms(root, **top)
    if cut is not None:
        (root / "transforms.json").write_text((root / "transforms.json").read_text()[:cut])

    try:
        for view in load_scene(root).views:
            view.load()
    except HyrfDataError as error:
        assert "\n" not in str(error)

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from hyrfpack.data import load_scene
from hyrfpack.errors import HyrfDataError

FIELD_OF_VIEW_RADIANS = 0.6911112070083618


def write_blender(root: Path, opengl_frames, splits=("train", "val", "test")) -> dict[str, list[np.ndarray]]:
    poses = {}
    for split in splits:
        names = [f"./{split}/r_{index}" for index in range(3)]
        frames, poses[split] = opengl_frames(names)
        (root / split).mkdir()
        for index in range(3):
            rgba = np.random.default_rng(index).integers(0, 256, (20, 30, 4), dtype=np.uint8)
            Image.fromarray(rgba).save(root / split / f"r_{index}.png")
        content = {"camera_angle_x": FIELD_OF_VIEW_RADIANS, "frames": frames}
        (root / f"transforms_{split}.json").write_text(json.dumps(content))
    return poses


def test_set_keeps_its_own_split_poses_and_straight_alpha(tmp_path, opengl_frames):
    poses = write_blender(tmp_path, opengl_frames)

    scene = load_scene(tmp_path)

    assert scene.layout == "blender" and scene.has_alpha and len(scene.points) == 0
    assert [view.name for view in scene.train] == ["train/r_0.png", "train/r_1.png", "train/r_2.png"]
    assert [view.name for view in scene.test] == ["test/r_0.png", "test/r_1.png", "test/r_2.png"]
    focal = 15 / np.tan(FIELD_OF_VIEW_RADIANS / 2)
    for view, pose in zip(scene.test, poses["test"], strict=True):
        np.testing.assert_allclose(view.camera.camera_from_world, pose, atol=1e-12)
        np.testing.assert_allclose(view.camera.intrinsics, (focal, focal, 15, 10))
    stored = np.random.default_rng(1).integers(0, 256, (20, 30, 4), dtype=np.uint8)
    np.testing.assert_array_equal(scene.train[1].load().rgb, stored[..., :3])
    np.testing.assert_array_equal(scene.train[1].load().alpha, stored[..., 3])


def test_masks_beside_the_photos_are_applied(tmp_path, opengl_frames):
    write_blender(tmp_path, opengl_frames)
    mask = np.full((20, 30), 255, np.uint8)
    mask[:, :10] = 0
    (tmp_path / "masks" / "train").mkdir(parents=True)
    Image.fromarray(mask).save(tmp_path / "masks" / "train" / "r_1.png")

    scene = load_scene(tmp_path)

    np.testing.assert_array_equal(scene.train[1].load().mask, mask > 0)
    assert scene.train[0].load().mask is None
    assert "1 of 6 photos has a mask" in scene.notes


def test_the_val_split_replaces_a_missing_test_split(tmp_path, opengl_frames):
    write_blender(tmp_path, opengl_frames, splits=("train", "val"))

    scene = load_scene(tmp_path)

    assert [view.name for view in scene.test] == ["val/r_0.png", "val/r_1.png", "val/r_2.png"]
    assert any("transforms_val.json are held out" in note for note in scene.notes)
    tables = [f"transforms_{split}.json" for split in ("train", "val")]
    photos = [f"{split}/r_{index}.png" for split in ("train", "val") for index in range(3)]
    assert sorted(scene.files) == sorted(str(tmp_path / name) for name in tables + photos)


def test_set_without_a_split_holds_out_every_nth(tmp_path, opengl_frames):
    write_blender(tmp_path, opengl_frames, splits=("train",))

    assert [view.name for view in load_scene(tmp_path, test_every=2).test] == ["train/r_0.png", "train/r_2.png"]


def _edit_transforms(root: Path, **entries) -> None:
    file = root / "transforms_train.json"
    content = json.loads(file.read_text()) | entries
    file.write_text(json.dumps({key: value for key, value in content.items() if value is not None}))


def _edit_frame(root: Path, **entries) -> None:
    file = root / "transforms_train.json"
    content = json.loads(file.read_text())
    content["frames"][1] |= entries
    file.write_text(json.dumps(content))


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (lambda root: _edit_transforms(root, camera_angle_x=None), "camera_angle_x"),
        (lambda root: _edit_transforms(root, camera_angle_x=float("nan")), "camera_angle_x"),
        (lambda root: _edit_transforms(root, camera_angle_x=4.0), "field of view"),
        (lambda root: _edit_transforms(root, frames=[]), "frames"),
        (lambda root: _edit_frame(root, transform_matrix=[[float("nan")] * 4] * 4), "not finite"),
        (lambda root: _edit_frame(root, transform_matrix=(np.eye(4) * 3).tolist()), "not rigid"),
        (lambda root: _edit_frame(root, transform_matrix=np.diag([-1.0, 1, 1, 1]).tolist()), "mirrors"),
        (lambda root: _edit_frame(root, transform_matrix=[[1, 2], [3, 4]]), "transform_matrix"),
        (lambda root: _edit_frame(root, transform_matrix=None), "transform_matrix"),
        (lambda root: _edit_frame(root, file_path=7), "file_path"),
        (lambda root: (root / "transforms_train.json").write_text('{"camera_angle_x": 0.7, "fra'), "JSON"),
        (lambda root: (root / "train" / "r_1.png").write_bytes(b""), "r_1.png"),
        (lambda root: [file.unlink() for file in (root / "train").iterdir()], "none of the 3 photos"),
        (lambda root: [file.unlink() for file in (root / "test").iterdir()], "none of the 3 photos"),
    ],
)
def test_a_broken_set_is_a_clear_error(tmp_path, opengl_frames, damage, says):
    write_blender(tmp_path, opengl_frames)
    damage(tmp_path)

    with pytest.raises(HyrfDataError, match=says) as caught:
        load_scene(tmp_path)

    assert "\n" not in str(caught.value) and str(tmp_path) in str(caught.value)


def test_intrinsics_of_other_programs_are_read_as_in_a_single_transforms_file(tmp_path, opengl_frames):
    """Add-ons of Blender and instant-ngp write splits with their full lenses."""
    lens = {"fl_x": 31.0, "fl_y": 29.0, "cx": 16.5, "cy": 9.0, "w": 30, "h": 20, "k1": 0.1, "p1": 0.001}
    for folder in ("split", "single"):
        (tmp_path / folder).mkdir()
        write_blender(tmp_path / folder, opengl_frames, splits=("train",))
        _edit_transforms(tmp_path / folder, camera_angle_x=0.9 if folder == "split" else None, **lens)
    (tmp_path / "single" / "transforms_train.json").rename(tmp_path / "single" / "transforms.json")

    split, single = (load_scene(tmp_path / folder, test_every=0) for folder in ("split", "single"))

    assert (split.layout, single.layout) == ("blender", "nerfstudio")
    assert [view.camera for view in split.train] == [view.camera for view in single.train]
    assert split.train[0].camera.fx == 31 and split.train[0].is_resampled

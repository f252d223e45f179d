"""What a folder contains: missing photos, several COLMAP models, and likely mistakes."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import pycolmap
import pytest
import trimesh
from commands import refused

from hyrfpack.data import load_scene
from hyrfpack.errors import HyrfDataError


def edit_transforms(root: Path, **entries) -> dict:
    content = json.loads((root / "transforms.json").read_text()) | entries
    (root / "transforms.json").write_text(json.dumps(content))
    return content


def error_of_loading(root: Path, **options) -> str:
    with pytest.raises(HyrfDataError) as caught:
        load_scene(root, **options)
    return str(caught.value)


def notes_of_loading(root: Path, **options) -> str:
    return "\n".join(load_scene(root, **options).notes)


# -- photos ----------------------------------------------------------------------------------------------------------


def test_photos_of_other_formats_are_named_where_none_is_found(tmp_path, colmap_folder):
    colmap_folder(tmp_path)
    for file in (tmp_path / "images").iterdir():
        file.rename(file.with_suffix(".dng"))

    assert "(looked for images/000.png; that folder holds 9 .dng files)" in error_of_loading(tmp_path)


@pytest.mark.parametrize(
    ("listed", "says"),
    [
        ("images/000.HEIC", "looked for images/000.HEIC; there is no folder images)"),
        ("frames/000.jpg", "looked for frames/000.jpg; that folder holds no file)"),
        ("000.jpg", "looked for 000.jpg; the folder holds 1 .json file)"),
    ],
)
def test_missing_photos_of_transforms_are_an_error_with_the_searched_paths(
    nerfstudio_folder, opengl_frames, listed, says
):
    root = nerfstudio_folder(1)
    shutil.rmtree(root / "images")
    (root / "frames").mkdir()
    edit_transforms(root, frames=opengl_frames([listed])[0])

    assert says in error_of_loading(root)


def test_missing_photos_of_blender_sets_are_an_error_with_the_searched_paths(tmp_path, opengl_frames):
    (tmp_path / "renders").mkdir()
    (tmp_path / "renders" / "r_0.exr").touch()
    content = {"camera_angle_x": 0.7, "frames": opengl_frames(["./renders/r_0"])[0]}
    (tmp_path / "transforms_train.json").write_text(json.dumps(content))

    assert "(looked for renders/r_0; that folder holds 1 .exr file)" in error_of_loading(tmp_path)


def test_the_first_skipped_photo_is_named(nerfstudio_folder):
    root = nerfstudio_folder(4)
    (root / "images" / "002.png").unlink()

    expected = "1 of 4 photos listed in transforms.json is not on disk and was skipped (such as images/002.png)"
    assert expected in load_scene(root).notes


def test_paths_with_backslashes_in_transforms_are_found(nerfstudio_folder, pictures):
    plain = load_scene(nerfstudio_folder(4))
    content = edit_transforms(Path(plain.path))
    for frame in content["frames"]:
        frame["file_path"] = frame["file_path"].replace("/", "\\")
    content["frames"][0]["mask_path"] = ".\\m\\first.png"
    names = [frame["file_path"] for frame in content["frames"]]
    root = nerfstudio_folder(4, **content, ply_file_path="points\\sparse.ply", train_filenames=names[:3])
    edit_transforms(root, test_filenames=names[3:])
    pictures(root, ["m/first.png"])
    (root / "points").mkdir()
    trimesh.PointCloud([[0.0, 0, 1]]).export(root / "points" / "sparse.ply")

    scene = load_scene(root)

    assert [view.name for view in scene.views] == [view.name for view in plain.views]
    assert [view.name for view in scene.test] == ["003.png"]
    assert scene.views[0].load().mask is not None and len(scene.points) == 1


def test_paths_with_backslashes_in_a_blender_set_are_found(tmp_path, opengl_frames, pictures):
    pictures(tmp_path, ["train/r_0.png"])
    content = {"camera_angle_x": 0.7, "frames": opengl_frames([".\\train\\r_0"])[0]}
    (tmp_path / "transforms_train.json").write_text(json.dumps(content))

    assert [view.name for view in load_scene(tmp_path, test_every=0).views] == ["train/r_0.png"]


# -- COLMAP models ---------------------------------------------------------------------------------------------------


def split_model(root: Path, colmap_folder, sizes: dict[str, int]) -> None:
    """Write models into `sparse/`, each with the first `size` photos of a set."""
    colmap_folder(root, count=max(sizes.values()))
    shutil.rmtree(root / "sparse")
    for name, count in sizes.items():
        made = colmap_folder(root, count=count, extra=False).model
        shutil.move(made, root / "moved")
        (root / "moved").rename(root / f"model {name}")
    for name in sizes:
        shutil.move(root / f"model {name}", root / "sparse" / name)


@pytest.mark.parametrize(
    ("sizes", "taken"),
    [({"0": 2, "1": 11, "2": 3}, "1"), ({"0": 5, "1": 5}, "0"), ({"10": 5, "9": 5}, "9"), ({"a": 5, "0": 5}, "0")],
)
def test_the_model_with_the_most_photos_is_used_and_noted(tmp_path, colmap_folder, sizes, taken):
    split_model(tmp_path, colmap_folder, sizes)

    scene = load_scene(tmp_path)

    assert len(scene.views) == sizes[taken]
    (note,) = [note for note in scene.notes if "COLMAP models" in note]
    assert note.startswith(f"there are {len(sizes)} COLMAP models: ")
    assert note.endswith(
        f"; {taken} is used, because it has the most photos; 'hyrfpack train' selects another with `model`"
    )
    assert all(f"{name} ({count} photos)" in note for name, count in sizes.items())
    assert all("sparse" not in file or f"sparse/{taken}/" in file for file in scene.files)


@pytest.mark.parametrize("comments", [True, False])
def test_photos_of_text_models_are_counted_too(tmp_path, colmap_folder, comments):
    split_model(tmp_path, colmap_folder, {"0": 2, "1": 11})
    for model in (tmp_path / "sparse").iterdir():
        pycolmap.Reconstruction(str(model)).write_text(str(model))
        for table in model.glob("*.bin"):
            table.unlink()
        if not comments:
            for table in model.glob("*.txt"):
                lines = table.read_text().splitlines(keepends=True)
                table.write_text("".join(line for line in lines if not line.startswith("#")))

    assert len(load_scene(tmp_path).views) == 11


def test_another_model_can_be_named(tmp_path, colmap_folder):
    split_model(tmp_path, colmap_folder, {"0": 2, "1": 11})

    scene = load_scene(tmp_path, model="0")

    assert len(scene.views) == 2
    assert "there are 2 COLMAP models: 0 (2 photos), 1 (11 photos); 0 is used, as requested" in scene.notes


def test_a_missing_model_is_rejected_and_existing_ones_are_named(tmp_path, colmap_folder):
    split_model(tmp_path, colmap_folder, {"0": 2, "1": 11})

    says = "there is no COLMAP model '7'; choose one of these: 0 (2 photos), 1 (11 photos)"
    assert says in error_of_loading(tmp_path, model="7")
    assert says in refused("train", tmp_path, "-o", tmp_path / "run", "--model", 7)


def test_a_model_for_a_layout_without_models_is_rejected(nerfstudio_folder):
    assert "'0' cannot be chosen; leave out `model`" in error_of_loading(nerfstudio_folder(), model="0")


def test_an_intact_model_is_preferred_to_a_damaged_one(tmp_path, colmap_folder):
    split_model(tmp_path, colmap_folder, {"0": 2, "1": 11})
    (tmp_path / "sparse" / "1" / "images.bin").unlink()

    assert len(load_scene(tmp_path).views) == 2


# -- likely mistakes -------------------------------------------------------------------------------------------------


def test_photos_that_share_one_pose_are_noted(nerfstudio_folder):
    root = nerfstudio_folder(5)
    content = edit_transforms(root)
    for index in (3, 4):
        content["frames"][index]["transform_matrix"] = content["frames"][1]["transform_matrix"]
    edit_transforms(root, frames=content["frames"])

    assert "3 photos have exactly the same pose as another (such as 001.png and 003.png)" in notes_of_loading(root)


@pytest.mark.parametrize("key", ["train_filenames", "test_filenames"])
def test_an_incomplete_split_is_noted_and_not_used(nerfstudio_folder, key):
    root = nerfstudio_folder(9)
    edit_transforms(root, **{key: ["images/001.png", "images/002.png"]})

    scene = load_scene(root)

    assert f"transforms.json lists {key} alone, which is half a split and is not used" in scene.notes
    assert (len(scene.train), len(scene.test)) == (7, 2)


def test_a_folder_named_mask_is_noted(tmp_path, colmap_folder, pictures):
    folder = colmap_folder(tmp_path)
    pictures(tmp_path / "mask", folder.names)

    assert "the folder mask is not read; rename it to masks" in load_scene(tmp_path).notes
    (tmp_path / "mask").rename(tmp_path / "masks")
    assert "not read" not in notes_of_loading(tmp_path)


def test_masks_without_a_photo_are_noted(nerfstudio_folder, pictures):
    root = nerfstudio_folder(4)
    pictures(root / "masks", ["000.png", "001_mask.png", "002_mask.png"])
    (root / "masks" / "readme.txt").touch()

    assert "2 of 3 masks in masks match no photo of the scene (such as 001_mask.png)" in notes_of_loading(root)


def test_a_set_without_problems_has_no_notes(nerfstudio_folder, pictures):
    root = nerfstudio_folder(4)
    pictures(root / "masks", [f"{index:03d}.png" for index in range(4)])

    assert load_scene(root).notes == ["4 of 4 photos have a mask"]


@pytest.mark.parametrize("name", ["x" * 300, "x/" * 3000 + "x", "a\0b"])
def test_impossible_folder_names_are_rejected(tmp_path, name):
    assert "no such folder" in error_of_loading(tmp_path / name)


def test_photos_may_lie_outside_the_folder_of_the_model(tmp_path, colmap_folder):
    folder = colmap_folder(tmp_path / "set")
    (tmp_path / "set" / "images").rename(tmp_path / "photos")

    scene = load_scene(tmp_path / "set", images=str(tmp_path / "photos"))

    assert len(scene.views) == folder.count


def test_folders_of_several_cameras_are_not_read_as_smaller_copies(tmp_path, colmap_folder, pictures):
    """The folders image_2 and image_3, as in KITTI, are not smaller copies."""
    folder = colmap_folder(tmp_path, count=4, extra=False)
    folder.names = [f"image_{2 + index % 2}/{index}.png" for index in range(4)]
    (folder.model / "images.bin").write_bytes(folder.tables()["images.bin"])
    pictures(tmp_path, folder.names)

    scene = load_scene(tmp_path)

    assert sorted(view.name for view in scene.views) == sorted(folder.names)
    assert "photos are read from the folder itself" in scene.notes


def test_folders_of_masks_previews_and_depth_maps_are_not_read_as_photos(tmp_path, colmap_folder, pictures):
    folder = colmap_folder(tmp_path, count=4)
    (tmp_path / "images").rename(tmp_path / "saturday")
    for other in ("depth", "masks", "thumbs", "stereo"):
        pictures(tmp_path / other, folder.names)

    assert "photos are read from saturday" in load_scene(tmp_path).notes


def test_folders_of_masks_may_be_links(tmp_path, colmap_folder, pictures):
    folder = colmap_folder(tmp_path / "set", count=4)
    pictures(tmp_path / "masks", folder.names)
    (tmp_path / "set" / "masks").mkdir()
    (tmp_path / "set" / "masks" / "mine").symlink_to(tmp_path / "masks")

    assert "4 of 4 photos have a mask" in load_scene(tmp_path / "set").notes


@pytest.mark.parametrize("name", ["", "images", "masks", "sparse", "sparse/0"])
@pytest.mark.parametrize("mode", [0o000, 0o444])
def test_unreadable_folders_are_a_clear_error(tmp_path, colmap_folder, pictures, name, mode):
    folder = colmap_folder(tmp_path / "set", count=4)
    pictures(tmp_path / "set" / "masks", folder.names)
    place = tmp_path / "set" / name
    place.chmod(mode)
    try:
        if os.access(place, os.R_OK | os.X_OK):
            pytest.skip("who runs this may read everything")
        assert "set" in error_of_loading(tmp_path / "set")
    finally:
        place.chmod(0o700)


@pytest.mark.parametrize("name", ["sparse", "sparse/0"])
def test_an_unreadable_model_is_not_treated_as_missing(tmp_path, colmap_folder, monkeypatch, name):
    colmap_folder(tmp_path, count=4)
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != tmp_path / name)

    assert f"{tmp_path / name}: permission to read the folder is denied; check its permissions" in error_of_loading(
        tmp_path
    )

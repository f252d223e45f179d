"""Photos for which no poses can be found give a clear error that says what to do."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from commands import refused
from made_up_photos import FOCAL_PIXELS, PHOTO_SIZE, arc_pose, render_photo, wall_textures
from PIL import Image
from scipy.spatial.transform import Rotation

import hyrfpack
from hyrfpack.poses import worker


def save_pictures(folder: Path, pictures: list[np.ndarray]) -> Path:
    folder.mkdir(exist_ok=True)
    for number, pixels in enumerate(pictures):
        Image.fromarray(pixels).save(folder / f"{number:02d}.png")
    return folder


def random_pictures(count: int, seed: int = 0) -> list[np.ndarray]:
    """Return pictures that have nothing in common."""
    rng = np.random.default_rng(seed)
    small = [rng.integers(0, 255, (30, 40, 3), np.uint8) for _ in range(count)]
    return [np.asarray(Image.fromarray(pixels).resize((160, 120), Image.Resampling.BICUBIC)) for pixels in small]


def test_a_folder_without_photos_is_a_clear_error(tmp_path):
    (tmp_path / "photos").mkdir()
    assert "there are no photos here" in refused("poses", tmp_path / "photos", "-o", tmp_path / "scene")
    (tmp_path / "photos" / "clip.MP4").touch()
    assert "the video clip.MP4; name the video itself" in refused(
        "poses", tmp_path / "photos", "-o", tmp_path / "scene"
    )
    assert "no such folder or video" in refused("poses", tmp_path / "missing", "-o", tmp_path / "scene")


@pytest.mark.parametrize("count, words", [(1, "1 photo is too few"), (2, "2 photos are too few")])
def test_too_few_photos_are_a_clear_error(count, words, tmp_path):
    photos = save_pictures(tmp_path / "photos", random_pictures(count))
    sentence = refused("poses", photos, "-o", tmp_path / "scene")
    assert words in sentence and "take 20 or more" in sentence


def test_a_single_photo_in_place_of_a_folder_is_a_clear_error(tmp_path):
    photos = save_pictures(tmp_path / "photos", random_pictures(1))
    assert "name the folder of all photos" in refused("poses", photos / "00.png", "-o", tmp_path / "scene")


@pytest.mark.parametrize(
    ("name", "what", "command"),
    [
        ("a.ply", "a file of splats", "hyrfpack import"),
        ("a.SPZ", "a file of splats", "hyrfpack import"),
        ("a.hyrf", "a model", "hyrfpack view"),
    ],
)
def test_splats_or_a_model_in_place_of_photos_are_a_clear_error(name, what, command, tmp_path):
    (tmp_path / name).write_bytes(b"ply")
    sentence = refused("poses", tmp_path / name, "-o", tmp_path / "scene")
    assert f"{name}: this is {what}, not photos or a video" in sentence and command in sentence
    assert "mp4" not in sentence and not (tmp_path / "scene").exists()


def test_copies_of_one_photo_are_a_clear_error(tmp_path):
    photos = save_pictures(tmp_path / "photos", random_pictures(1) * 5)
    assert "4 of 5 files are copies of another" in refused("poses", photos, "-o", tmp_path / "scene")


def test_files_that_are_no_pictures_are_a_clear_error(tmp_path):
    (tmp_path / "photos").mkdir()
    for number in range(4):
        (tmp_path / "photos" / f"{number}.jpg").write_bytes(b"no picture %d" % number)
    sentence = refused("poses", tmp_path / "photos", "-o", tmp_path / "scene")
    assert "4 of 4 photos cannot be read: 0.jpg, 1.jpg, 2.jpg and 1 more" in sentence
    assert sentence.endswith("copy them again, or remove them")


def test_truncated_photos_are_a_clear_error(tmp_path):
    photos = save_pictures(tmp_path / "photos", random_pictures(4))
    for path in photos.iterdir():
        path.write_bytes(path.read_bytes()[:2000])
    sentence = refused("poses", photos, "-o", tmp_path / "scene")
    assert "4 of 4 photos cannot be read: 00.png, 01.png, 02.png and 1 more (cannot decode the picture" in sentence
    assert ".poses" not in sentence


@pytest.mark.acceptance
def test_photos_without_features_are_a_clear_error(tmp_path):
    rng = np.random.default_rng(0)
    level = [np.full((120, 160, 3), 100, np.uint8) + rng.integers(0, 2, (120, 160, 3), np.uint8) for _ in range(5)]
    sentence = refused("poses", save_pictures(tmp_path / "photos", level), "-o", tmp_path / "scene")
    assert "these photos have too few features" in sentence


@pytest.mark.acceptance
def test_photos_without_overlap_are_a_clear_error(tmp_path):
    photos = save_pictures(tmp_path / "photos", random_pictures(6))
    sentence = refused("poses", photos, "-o", tmp_path / "scene")
    assert "0 pairs of these 6 photos have enough matches" in sentence
    assert (tmp_path / "scene" / ".poses" / "database.db").is_file()


@pytest.mark.acceptance
def test_photos_from_one_place_are_a_clear_error(tmp_path):
    textures, pose = wall_textures(), arc_pose(0.5)
    pictures = []
    for number in range(5):
        turned = Rotation.from_euler("y", 8 * (number - 2), degrees=True).as_matrix() @ pose
        pictures.append(render_photo(turned, textures, PHOTO_SIZE, FOCAL_PIXELS))
    sentence = refused("poses", save_pictures(tmp_path / "photos", pictures), "-o", tmp_path / "scene")
    assert "all photos were taken from one place" in sentence and "a step to the side" in sentence


def test_masks_without_matching_photos_are_a_clear_error(photos_and_poses, tmp_path, caplog):
    (tmp_path / "masks").mkdir()
    for name in ("one", "two"):
        Image.new("L", PHOTO_SIZE, 255).save(tmp_path / "masks" / f"{name}.png")
    with pytest.raises(hyrfpack.HyrfDataError, match="no mask has the name of a photo"):
        hyrfpack.estimate_poses(photos_and_poses[0], tmp_path / "scene", masks=tmp_path / "masks")
    assert "2 of 2 masks in masks match no photo of the scene (such as one.png)" in caplog.text


def test_masks_of_another_shape_are_refused_before_photos_are_copied(tmp_path):
    photos = save_pictures(tmp_path / "photos", random_pictures(4))
    save_pictures(photos / "masks", [np.full((120, 120), 255, np.uint8)] * 4)
    sentence = refused("poses", photos, "-o", tmp_path / "scene")
    assert "00.png: the mask is 120 x 120 but its photo 160 x 120; resize it to the photo's size" in sentence
    assert not (tmp_path / "scene").exists()


def test_a_scene_folder_that_cannot_be_created_is_a_clear_error(photos_and_poses, tmp_path):
    (tmp_path / "file").touch()
    assert "this is a file" in refused("poses", photos_and_poses[0], "-o", tmp_path / "file")
    shutil.copytree(photos_and_poses[0], tmp_path / "scene" / "images")
    (tmp_path / "scene" / "images" / "other.png").touch()
    assert "do not belong to these photos" in refused("poses", photos_and_poses[0], "-o", tmp_path / "scene")


def test_without_pycolmap_a_stage_says_what_to_install(monkeypatch, capsys):
    monkeypatch.setattr(worker, "_exit_with_parent", lambda: None)
    monkeypatch.setattr(worker.Job, "load", lambda path: None)
    monkeypatch.delitem(sys.modules, "hyrfpack.poses.features", raising=False)
    monkeypatch.setitem(sys.modules, "pycolmap", None)

    worker.main("job", "features")

    problem, fix = json.loads(capsys.readouterr().out)["answer"]["failed"]
    assert (problem, fix) == ("estimating poses needs pycolmap", "run 'pip install \"hyrfpack[poses]\"'")

"""Panoramas are cut into faces, which are posed like photos."""

from __future__ import annotations

import numpy as np
import pytest
from made_up_photos import arc_pose, render_panorama, wall_textures
from PIL import Image

import hyrfpack
from hyrfpack.data.equirectangular import CUBE_FACES
from hyrfpack.poses.alignment import align_poses
from hyrfpack.poses.prepare import find_masks, make_masks, read_headers

PANORAMA_COUNT = 3
PANORAMA_HEIGHT = 320


@pytest.fixture(scope="module")
def panoramas(tmp_path_factory):
    """A folder of panoramas, and the pose of the forward direction of each."""
    folder, textures = tmp_path_factory.mktemp("panoramas"), wall_textures()
    truth = {f"p{number}": arc_pose(number / (PANORAMA_COUNT - 1)) for number in range(PANORAMA_COUNT)}
    for name, pose in truth.items():
        Image.fromarray(render_panorama(pose, textures, PANORAMA_HEIGHT, finer=2)).save(
            folder / f"{name}.jpg", quality=95
        )
    return folder, truth


@pytest.mark.acceptance
def test_the_faces_of_panoramas_are_posed(panoramas, tmp_path):
    folder, truth = panoramas
    found = hyrfpack.estimate_poses(folder, tmp_path / "scene")
    assert found.photos == PANORAMA_COUNT * len(CUBE_FACES)
    assert f"{PANORAMA_COUNT} panoramas were cut into {PANORAMA_COUNT * len(CUBE_FACES)} photos" in found.notes
    expected = {f"{name}_{face.name}.jpg": face.rotation @ pose for name, pose in truth.items() for face in CUBE_FACES}
    views = hyrfpack.load_scene(tmp_path / "scene").views
    assert {f"p{number}_front.jpg" for number in range(PANORAMA_COUNT)} <= {view.name for view in views}
    poses = {view.name: view.camera.camera_from_world[:3] for view in views}
    assert len(align_poses(poses, expected).agreeing) >= PANORAMA_COUNT
    for view in views:  # each face is 90 degrees wide
        assert view.camera.fx == pytest.approx(view.camera.width / 2, rel=0.05)


def test_panoramas_are_not_cut_among_the_photos_of_others(panoramas, tmp_path):
    folder, _ = panoramas
    (tmp_path / "scene").mkdir()
    (tmp_path / "scene" / "images").symlink_to(folder, target_is_directory=True)
    with pytest.raises(
        hyrfpack.HyrfDataError, match="is a panorama, which cannot be cut into photos in its own folder"
    ):
        hyrfpack.estimate_poses(tmp_path / "scene", tmp_path / "scene")


def test_masks_of_panoramas_are_cut_with_them(panoramas, tmp_path):
    folder, _ = panoramas
    mask = np.full((PANORAMA_HEIGHT, 2 * PANORAMA_HEIGHT), 255, np.uint8)
    mask[PANORAMA_HEIGHT // 2 :] = 0  # everything below the horizon
    (tmp_path / "masks").mkdir()
    Image.fromarray(mask).save(tmp_path / "masks" / "p0.png")
    photos, left_out = read_headers(folder, [folder / "p0.jpg"], in_place=False)
    assert len(photos) == len(CUBE_FACES) and not left_out
    made = make_masks(photos, find_masks(photos, tmp_path / "masks", in_place=False).by_photo, tmp_path / "made")
    usable = {name: np.asarray(Image.open(path).convert("L")) > 0 for name, path in made.items()}
    assert usable["p0_up.jpg"].all() and not usable["p0_down.jpg"].any()
    front = usable["p0_front.jpg"]
    assert front[: len(front) // 2 - 1].all() and not front[len(front) // 2 + 1 :].any()


def test_a_mask_of_a_face_in_place_of_a_panorama_is_refused(panoramas, tmp_path):
    folder, _ = panoramas
    (tmp_path / "masks").mkdir()
    Image.new("L", (100, 100), 255).save(tmp_path / "masks" / "p0.png")
    photos, _ = read_headers(folder, [folder / "p0.jpg"], in_place=False)
    with pytest.raises(hyrfpack.HyrfDataError, match="the mask is 100 x 100 but its photo 640 x 320"):
        find_masks(photos, tmp_path / "masks", in_place=False)

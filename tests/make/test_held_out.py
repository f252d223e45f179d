"""Which photo of a small set is held out, and the note about its score."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
from commands import succeeded
from scenes import QUIET_CONTEXT

from hyrfpack import load_scene
from hyrfpack.make.held_out import MAX_PSNR_GAP_DB, choose_inner_view, score_note
from hyrfpack.make.source import LoadSettings
from hyrfpack.scene import Camera, Scene, View
from hyrfpack.train import TrainConfig, load_training_scene, train_model


def camera_looking_at(position: tuple[float, float, float], target: tuple[float, float, float]) -> Camera:
    """Return a camera at `position` that looks at `target`, with y downwards."""
    forward = np.subtract(target, position) / np.linalg.norm(np.subtract(target, position))
    right = np.cross((0.0, 1.0, 0.0), forward)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = right, np.cross(forward, right), forward
    pose[:3, 3] = -pose[:3, :3] @ position
    return Camera(32, 24, 30.0, 30.0, 16.0, 12.0, pose)


def scene_with_cameras(cameras: list[Camera], points: bool = True) -> Scene:
    views = [View(f"{number:02}.jpg", camera, lambda: None) for number, camera in enumerate(cameras)]
    cloud = np.random.default_rng(0).normal(0, 0.3, (50 if points else 0, 3))
    return Scene("here", "colmap", views, [], cloud, np.zeros((len(cloud), 3), np.float32))


@pytest.mark.parametrize("points", [True, False], ids=["with points", "without"])
def test_from_a_row_of_cameras_an_inner_one_is_held_out(points):
    places = [(x, 0.0, -5.0) for x in np.linspace(-2, 2, 9)]
    cameras = [camera_looking_at(place, (place[0], 0.0, 0.0)) for place in places]
    assert choose_inner_view(scene_with_cameras(cameras, points)).name in {
        "02.jpg",
        "03.jpg",
        "04.jpg",
        "05.jpg",
        "06.jpg",
    }


def test_from_a_grid_of_cameras_the_middle_one_is_held_out():
    places = [(x, y, -5.0) for x in (-1.0, 0.0, 1.0) for y in (-1.0, 0.0, 1.0)]
    cameras = [camera_looking_at(place, (place[0], place[1], 0.0)) for place in places]
    assert choose_inner_view(scene_with_cameras(cameras)).name == "04.jpg"


def test_the_first_photo_at_the_end_of_an_arc_is_not_held_out():
    angles = np.radians([-80, -20, -12, -4, 4, 12, 20, 28, 36, 44, 52])
    cameras = [camera_looking_at((5 * np.sin(a), 0.0, -5 * np.cos(a)), (0.0, 0.0, 0.0)) for a in angles]
    chosen = choose_inner_view(scene_with_cameras(cameras)).name
    assert chosen not in {"00.jpg", "01.jpg", "09.jpg", "10.jpg"}


def test_a_middle_camera_with_another_viewing_direction_is_not_held_out():
    places = [(x, y, -5.0) for x in (-1.0, 0.0, 1.0) for y in (-1.0, 0.0, 1.0)]
    cameras = [camera_looking_at(place, (place[0], place[1], 0.0)) for place in places]
    cameras[4] = camera_looking_at((0.0, 0.0, -5.0), (0.2, 0.0, -9.0))
    assert choose_inner_view(scene_with_cameras(cameras)).name != "04.jpg"


def test_a_camera_is_chosen_also_where_all_are_in_one_place():
    cameras = [camera_looking_at((0.0, 0.0, 0.0), (np.sin(a), 0.0, np.cos(a))) for a in np.radians(range(0, 90, 10))]
    assert choose_inner_view(scene_with_cameras(cameras, points=False)).name not in {"00.jpg", "08.jpg"}


@pytest.mark.parametrize("count, held_out", [(7, 0), (8, 1), (15, 1), (16, 2)])
def test_small_sets_hold_out_an_inner_photo_and_larger_ones_every_eighth(count, held_out, posed, tmp_path):
    few = copy_first_photos(posed, tmp_path, count)
    scene = LoadSettings().load(few)
    expected = [] if held_out == 0 else [choose_inner_view(scene).name] if held_out == 1 else ["0000.png", "0008.png"]
    assert [view.name for view in scene.test] == expected
    assert [view.name for view in load_scene(few).test] == ["0000.png", "0008.png"][: 2 if count > 8 else 1]


def test_a_split_defined_by_the_set_is_used(posed, tmp_path):
    few = copy_first_photos(posed, tmp_path, 9)
    table = json.loads((few / "transforms.json").read_text())
    names = [frame["file_path"] for frame in table["frames"]]
    table |= {"train_filenames": names[:-1], "val_filenames": [], "test_filenames": names[-1:]}
    (few / "transforms.json").write_text(json.dumps(table))
    assert [view.name for view in LoadSettings().load(few).test] == ["0008.png"]


def test_photos_of_a_run_on_a_small_set_have_the_same_held_out_photo(posed, tmp_path):
    scene = LoadSettings().load(copy_first_photos(posed, tmp_path, 9))
    train_model(scene, tmp_path / "run", TrainConfig(steps=1, max_gaussians=50), context=QUIET_CONTEXT)
    again = load_training_scene(tmp_path / "run" / "model.hyrf")
    assert [view.name for view in again.test] == [choose_inner_view(again).name]


@pytest.mark.parametrize(
    "views, psnr, training, said",
    [
        (3, 25.0, 25.0 + MAX_PSNR_GAP_DB, False),
        (3, 25.0, 25.1 + MAX_PSNR_GAP_DB, True),
        (3, 25.0, None, False),
        (2, 25.0, 25.0, True),
        (1, 25.0, 25.0, True),
        (0, None, 25.0, False),
    ],
)
def test_an_unreliable_score_has_a_note(views, psnr, training, said):
    assert bool(score_note(views, psnr, training)) == said


def test_the_note_names_the_gap_to_the_training_score():
    note = score_note(1, 8.5, 25.0)
    assert "only 1 photo was held out" in note and "16.5 dB less" in note and "(25.0 dB)" in note


@pytest.mark.usefixtures("fake_stages")
def test_the_command_prints_the_note_and_includes_it_in_its_json(posed, tmp_path):
    few = copy_first_photos(posed, tmp_path, 9)
    arguments = ("make", few, "-o", tmp_path / "scene.hyrf", "--quality", "draft")
    assert "only 1 photo was held out" in succeeded(*arguments).stdout
    assert "only 1 photo was held out" in json.loads(succeeded(*arguments, "--json").stdout)["note"]


def copy_first_photos(posed, tmp_path, count):
    """Copy the first `count` photos of the set."""
    few = tmp_path / "few"
    shutil.copytree(posed, few)
    table = json.loads((few / "transforms.json").read_text())
    table["frames"] = table["frames"][:count]
    (few / "transforms.json").write_text(json.dumps(table))
    return few

"""`load_training_scene` reads the photos of a run from what its folder says, which may be outdated or wrong."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from scenes import QUIET_CONTEXT

import hyrfpack
from hyrfpack.errors import HyrfDataError
from hyrfpack.train import load_training_scene
from hyrfpack.train.photos import read_recorded_split


@pytest.fixture(scope="module")
def run(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short run on photos that were split and resized in a way that is not the default."""
    folder = tmp_path_factory.mktemp("load_training_scene") / "run"
    scene = hyrfpack.load_scene(data, test_every=5, max_size=40)
    hyrfpack.train_model(scene, folder, hyrfpack.TrainConfig(steps=3, max_gaussians=100), context=QUIET_CONTEXT)
    return folder


def copy_run_with(run: Path, folder: Path, **reading: object) -> Path:
    """Copy the run with other facts about its photos, and return the path of its model."""
    shutil.copytree(run, folder)
    metrics = json.loads((folder / "metrics.json").read_text())
    metrics["scene"]["reading"] |= reading
    (folder / "metrics.json").write_text(json.dumps(metrics))
    return folder / "model.hyrf"


def test_load_training_scene_a_run_are_read_and_split_as_in_training(run, data, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)  # the command may run in any folder
    scene, same = load_training_scene(run / "model.hyrf"), hyrfpack.load_scene(data, test_every=5, max_size=40)
    assert [view.name for view in scene.train] == [view.name for view in same.train]
    assert [view.name for view in scene.test] == [view.name for view in same.test]
    assert scene.train[0].camera.width == 40


def test_a_relative_path_is_stored_as_an_absolute_one(data, monkeypatch):
    monkeypatch.chdir(data.parent)
    assert hyrfpack.load_scene(data.name).reading["path"] == str(data)


def test_a_file_outside_a_run_has_no_photos(run, tmp_path):
    shutil.copy(run / "model.hyrf", tmp_path / "other.hyrf")
    shutil.copy(run / "model.hyrf", tmp_path / "model.hyrf")
    assert load_training_scene(tmp_path / "other.hyrf") is None and load_training_scene(tmp_path / "model.hyrf") is None


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"scene": 3}', '{"scene": {"reading": {}, "train": 1, "test": 1}}'])
def test_metrics_without_facts_about_photos_give_no_photos(text, run, tmp_path):
    shutil.copy(run / "model.hyrf", tmp_path / "model.hyrf")
    (tmp_path / "metrics.json").write_text(text)
    assert load_training_scene(tmp_path / "model.hyrf") is None


@pytest.mark.parametrize(
    "reading",
    [
        {"path": 3},
        {"path": "a\0b"},
        {"layout": "none"},
        {"test_every": -1},
        {"test_every": True},
        {"held_out": [1]},
        {"more": 1},
    ],
    ids=str,
)
def test_metrics_with_invalid_facts_give_no_photos(reading, run, tmp_path):
    assert load_training_scene(copy_run_with(run, tmp_path / "run", **reading)) is None


@pytest.mark.parametrize("size", ["8", None, 8.0, True])
def test_metrics_with_invalid_numbers_of_photos_give_no_photos(size, run, tmp_path):
    model = copy_run_with(run, tmp_path / "run")
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    metrics["scene"]["train"] = size
    (tmp_path / "run" / "metrics.json").write_text(json.dumps(metrics))
    assert load_training_scene(model) is None


def test_photos_that_are_gone_are_a_clear_error(run, tmp_path):
    with pytest.raises(HyrfDataError, match="no such folder"):
        load_training_scene(copy_run_with(run, tmp_path / "run", path=str(tmp_path / "moved")))


def test_photos_that_have_changed_since_are_a_clear_error(run, tmp_path):
    with pytest.raises(HyrfDataError, match="name the photos with `data`"):
        load_training_scene(copy_run_with(run, tmp_path / "run", test_every=2))


def test_the_split_of_a_run_holds_for_its_own_photos_only(run, data, tmp_path):
    assert read_recorded_split(run / "model.hyrf", data, {}) == {"test_every": 5}
    assert (
        read_recorded_split(run / "model.hyrf", tmp_path, {}) == read_recorded_split(run / "other.hyrf", data, {}) == {}
    )


def test_the_split_of_a_run_does_not_hold_for_photos_that_are_read_otherwise(run, data):
    assert read_recorded_split(run / "model.hyrf", data, {"max_size": 30, "images": "images_2"}) == {}
    assert read_recorded_split(run / "model.hyrf", data, {"layout": "colmap"}) == {}
    assert read_recorded_split(run / "model.hyrf", data, {"max_size": 30}) == {"test_every": 5}


def test_a_path_that_no_file_can_have_is_no_record(run, data, tmp_path):
    model = copy_run_with(run, tmp_path / "copy", path="\ud800x")
    assert read_recorded_split(model, data, {}) == {} and load_training_scene(model) is None


def test_a_reading_that_is_a_list_of_pairs_is_read_like_an_object(run, data, tmp_path):
    shutil.copytree(run, tmp_path / "copy")
    metrics = json.loads((run / "metrics.json").read_text())
    metrics["scene"]["reading"] = list(metrics["scene"]["reading"].items())
    (tmp_path / "copy" / "metrics.json").write_text(json.dumps(metrics))
    assert read_recorded_split(tmp_path / "copy" / "model.hyrf", data, {}) == {"test_every": 5}

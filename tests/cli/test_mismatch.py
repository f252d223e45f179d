"""`evaluate` and `render --data` say when photos are not those that a model was trained on, and go on."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from commands import succeeded
from scenes import small_model

import hyrfpack
from hyrfpack.cameras.capture import scene_provenance

SENTENCE = "another coordinate frame; name the photos and poses that it was trained on"


@pytest.fixture
def model(data, tmp_path) -> Path:
    """A file that says that it was trained on the set of the fixture `data`."""
    hyrfpack.save_model(
        small_model([[0.0, 0.0, 0.0]]), tmp_path / "model.hyrf", provenance=scene_provenance(hyrfpack.load_scene(data))
    )
    return tmp_path / "model.hyrf"


@pytest.fixture
def moved(data, tmp_path) -> Path:
    """The same photos under the same names, their poses in another coordinate frame."""
    folder = Path(shutil.copytree(data, tmp_path / "moved"))
    table = folder / "transforms.json"
    content = json.loads(table.read_text())
    for frame in content["frames"]:
        frame["transform_matrix"][0][3] += 100
    table.write_text(json.dumps(content))
    return folder


def test_evaluate_tells_of_poses_in_another_frame_with_a_clear_error_and_scores(model, data, moved):
    assert SENTENCE not in succeeded("evaluate", model, "--data", data).stderr
    told = succeeded("evaluate", model, "--data", moved, "--json")
    assert told.stderr.count(SENTENCE) == 1
    assert json.loads(told.stdout)["psnr"] > 0


def test_render_tells_of_poses_in_another_frame_and_renders(model, data, moved, tmp_path):
    assert SENTENCE not in succeeded("render", model, "-o", tmp_path / "a", "--data", data).stderr
    assert succeeded("render", model, "-o", tmp_path / "b", "--data", moved).stderr.count(SENTENCE) == 1
    assert len(list((tmp_path / "b").iterdir())) == 2

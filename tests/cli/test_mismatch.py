"""Photos that a model was not trained on: scored and rendered with a note, refused where the output depends on them."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from commands import refused, succeeded
from scenes import small_model

import hyrfpack
from hyrfpack.cameras.capture import scene_provenance

MISMATCH_NOTE = "another coordinate frame; name the photos and poses that it was trained on"


@pytest.fixture
def model(data, tmp_path) -> Path:
    """A model file that names the set of the fixture `data` as its training photos."""
    hyrfpack.save_model(
        small_model([[0.0, 0.0, 0.0]]), tmp_path / "model.hyrf", provenance=scene_provenance(hyrfpack.load_scene(data))
    )
    return tmp_path / "model.hyrf"


@pytest.fixture
def data_in_another_frame(data, tmp_path) -> Path:
    """The same photos under the same names, with poses in another coordinate frame."""
    folder = Path(shutil.copytree(data, tmp_path / "moved"))
    table = folder / "transforms.json"
    content = json.loads(table.read_text())
    for frame in content["frames"]:
        frame["transform_matrix"][0][3] += 100
    table.write_text(json.dumps(content))
    return folder


def test_evaluate_notes_poses_in_another_frame_and_scores(model, data, data_in_another_frame):
    assert MISMATCH_NOTE not in succeeded("evaluate", model, "--data", data).stderr
    messages = succeeded("evaluate", model, "--data", data_in_another_frame, "--json")
    assert messages.stderr.count(MISMATCH_NOTE) == 1
    assert json.loads(messages.stdout)["psnr"] > 0


def test_render_notes_poses_in_another_frame_and_renders(model, data, data_in_another_frame, tmp_path):
    assert MISMATCH_NOTE not in succeeded("render", model, "-o", tmp_path / "a", "--data", data).stderr
    assert (
        succeeded("render", model, "-o", tmp_path / "b", "--data", data_in_another_frame).stderr.count(MISMATCH_NOTE)
        == 1
    )
    assert len(list((tmp_path / "b").iterdir())) == 2


@pytest.mark.parametrize(
    ("command", "output"),
    [
        ("compress", "small.hyrf"),
        ("edit --crop-sphere 0,0,0,1 --max-psnr-drop 1", "edited.hyrf"),
        ("export", "model.ply"),
        ("split", "chunks"),
    ],
)
def test_commands_that_fit_or_choose_by_photos_refuse_other_ones(
    model, data_in_another_frame, tmp_path, command, output
):
    name, *options = command.split()
    message = refused(name, model, "-o", tmp_path / output, *options, "--data", data_in_another_frame)
    assert MISMATCH_NOTE in message and not (tmp_path / output).exists()

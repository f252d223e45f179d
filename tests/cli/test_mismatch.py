"""Photos that a model was not trained on, and held-out photos that it was: scored with a note, refused or found again.

Where the output depends on photos that the model was not trained on, they are refused.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from commands import refused, succeeded
from scenes import QUIET_CONTEXT, small_model

import hyrfpack
from hyrfpack.cameras.capture import scene_provenance
from hyrfpack.config.edit import MinOpacity
from hyrfpack.errors import HyrfDataError

LEAK_NOTE = "among those of the held-out photos, so the model was trained on some of them"
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


def test_python_refuses_to_edit_with_photos_of_another_frame(model, data_in_another_frame, tmp_path):
    photos = hyrfpack.load_scene(data_in_another_frame)
    with pytest.raises(HyrfDataError, match="another coordinate frame"):
        hyrfpack.plan_edit(model, [MinOpacity(0.1)], data=photos)
    with pytest.raises(HyrfDataError, match="another coordinate frame"):
        hyrfpack.edit_model(model, tmp_path / "x.hyrf", [MinOpacity(0.1)], data=photos)


def test_python_refuses_to_split_with_photos_of_another_frame(model, data_in_another_frame, tmp_path):
    photos = hyrfpack.load_scene(data_in_another_frame)
    with pytest.raises(HyrfDataError, match="another coordinate frame"):
        hyrfpack.split_model(model, tmp_path / "chunks", data=photos)
    assert not (tmp_path / "chunks").exists()


def test_photos_of_the_edited_part_of_a_merged_file_are_accepted_and_others_are_refused(
    model, data, data_in_another_frame, tmp_path
):
    moved = hyrfpack.load_scene(data_in_another_frame)
    other = tmp_path / "other.hyrf"
    hyrfpack.save_model(small_model([[0.0, 0.0, 0.0]]), other, provenance=scene_provenance(moved))
    merged = tmp_path / "merged.hyrf"
    succeeded("merge", other, model, "-o", merged)
    command = ["edit", merged, "--plan", "--min-opacity", "0.001", "--part"]
    succeeded(*command, "model", "--data", data)
    succeeded(*command, "other", "--data", data_in_another_frame)
    assert "another coordinate frame" in refused(*command, "model", "--data", data_in_another_frame)
    assert "another coordinate frame" in refused(*command, "other", "--data", data)


def test_a_note_says_if_held_out_photos_are_among_those_of_training(model, data, tmp_path):
    assert LEAK_NOTE not in succeeded("evaluate", model, "--data", data).stderr
    message = succeeded("evaluate", model, "--data", data, "--test-every", 5).stderr
    assert message.count(LEAK_NOTE) == 1 and "of the 8 cameras" in message and "1 is among" in message
    message = succeeded("render", model, "-o", tmp_path / "out", "--data", data, "--test-every", 3).stderr
    assert message.count(LEAK_NOTE) == 1 and "with --test-every" in message


def test_few_rounded_cameras_suffice_to_notice_held_out_photos_of_training(model, data, tmp_path):
    hyrfpack.compress_model(model, tmp_path / "small.hyrf", data=None)
    assert LEAK_NOTE not in succeeded("evaluate", tmp_path / "small.hyrf", "--data", data).stderr
    assert LEAK_NOTE in succeeded("evaluate", tmp_path / "small.hyrf", "--data", data, "--test-every", 3).stderr


@pytest.mark.parametrize(
    ("reading", "names"), [({"test_every": 5}, ["0000.png", "0005.png"]), ({"held_out": ["0004.png"]}, ["0004.png"])]
)
def test_a_run_is_scored_on_the_photos_that_it_held_out(reading, names, data, tmp_path):
    scene, run = hyrfpack.load_scene(data, **reading), tmp_path / "run"
    hyrfpack.train_model(scene, run, hyrfpack.TrainConfig(steps=2, max_gaussians=60), context=QUIET_CONTEXT)
    scored = succeeded("evaluate", run, "--data", data, "--json")
    assert [view["name"] for view in json.loads(scored.stdout)["views"]] == names
    assert LEAK_NOTE not in scored.stderr
    copy = Path(shutil.copytree(data, tmp_path / "copy"))
    for options in (["--data", copy], ["--data", data, "--test-every", 8]):
        scored = succeeded("evaluate", run, *options, "--json")
        assert [view["name"] for view in json.loads(scored.stdout)["views"]] == ["0000.png", "0008.png"]
        assert LEAK_NOTE in scored.stderr

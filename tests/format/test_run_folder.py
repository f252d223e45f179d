"""A path selects a model file or a run folder, and unfinished runs are reported."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import pytest
import torch
from commands import succeeded
from denied_access import deny_access
from scenes import small_model

import hyrfpack
from hyrfpack.errors import HyrfFormatError
from hyrfpack.format import run_folder as run_folder_module
from hyrfpack.format.run_folder import find_model, is_run_folder, read_run_status
from hyrfpack.format.scene_folder import is_scene
from hyrfpack.splats.files import read_splats
from hyrfpack.train.checkpoint import save_checkpoint
from tools.safety.make_golden import GOLDEN_SCENE_FOLDER

GAUSSIAN_POSITIONS = [[0.0, 0, 0], [0.3, 0, 0]]


@pytest.fixture
def run_folder(tmp_path: Path) -> Path:
    """Create the folder of a finished run of 1,200 steps with metrics.json as `hyrfpack train` writes it."""
    folder = tmp_path / "bonsai"
    hyrfpack.save_model(small_model(GAUSSIAN_POSITIONS), folder / "model.hyrf")
    metrics = {
        "settings": {"steps": 1200},
        "scene": {"path": "photos/bonsai", "train": 7, "test": 2},
        "seconds": 12.5,
        "evaluation": {"psnr": 25.5, "psnr_consistent": 21.25, "ssim": 0.75},
    }
    (folder / "metrics.json").write_text(json.dumps(metrics))
    return folder


@pytest.fixture
def unfinished_folder(tmp_path: Path) -> Path:
    """Create the folder of a run that was interrupted at step 120 of 3,000."""
    folder = tmp_path / "early"
    folder.mkdir()
    write_checkpoint(folder, 120, {"steps": 3000})
    return folder


def write_checkpoint(folder: Path, step: int, settings: dict) -> None:
    tensors = {"model.positions": torch.zeros(50, 3)}
    save_checkpoint(folder / "checkpoint.pt", settings=settings, tensors=tensors, progress={"step": step})


def test_a_file_path_and_a_run_folder_select_a_model(run_folder):
    assert (
        find_model(run_folder) == run_folder / "model.hyrf" and find_model(str(run_folder)) == run_folder / "model.hyrf"
    )
    assert find_model("elsewhere/a.hyrf") == Path("elsewhere/a.hyrf")


@pytest.mark.parametrize("name", ["pilots.json", "pilot.pt", "teacher-1.hyrf", "blocks/blocks.json"])
def test_a_run_that_was_stopped_before_its_first_checkpoint_has_not_finished(tmp_path, name):
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text("{}")

    assert is_run_folder(tmp_path)
    with pytest.raises(HyrfFormatError, match="the run has not finished; finish it by running its 'hyrfpack train'"):
        find_model(tmp_path)


def test_the_run_of_an_interrupted_make_is_finished_by_the_same_command(tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "pilots.json").write_text("{}")
    (tmp_path / "make.json").write_text("{}")
    with pytest.raises(HyrfFormatError, match="has not finished; finish it by repeating its 'hyrfpack make' command"):
        find_model(tmp_path / "run")
    assert "repeating its 'hyrfpack make' command" in succeeded("info", tmp_path / "run").stdout


def test_the_work_folder_of_an_interrupted_make_names_its_preview(tmp_path):
    (tmp_path / "make.json").write_text("{}")
    with pytest.raises(HyrfFormatError, match="the work folder of 'hyrfpack make'.*repeat it, which resumes$"):
        find_model(tmp_path)
    (tmp_path / "preview.hyrf").write_bytes(b"")
    with pytest.raises(HyrfFormatError, match=r"repeat it, which resumes, or name .*preview\.hyrf$"):
        find_model(tmp_path)


def test_the_model_of_a_run_comes_before_a_scene_in_its_folder(run_folder):
    """A scene that was split from an older model of the run would be read otherwise."""
    shutil.copytree(GOLDEN_SCENE_FOLDER, run_folder, dirs_exist_ok=True)

    assert find_model(run_folder) == run_folder / "model.hyrf" and not is_scene(run_folder)
    assert is_scene(run_folder / "scene.json")
    assert len(hyrfpack.load_model(run_folder)) == hyrfpack.describe_file(run_folder)["gaussians"]
    assert len(hyrfpack.load_model(run_folder)) == len(GAUSSIAN_POSITIONS)


@pytest.mark.parametrize("name", ["checkpoint.pt", "pilots.json"])
def test_an_unfinished_run_comes_before_a_scene_of_an_older_model_in_its_folder(tmp_path, name):
    shutil.copytree(GOLDEN_SCENE_FOLDER, tmp_path, dirs_exist_ok=True)
    (tmp_path / name).write_text("{}")

    assert not is_scene(tmp_path)
    for call in (find_model, hyrfpack.load_model, hyrfpack.describe_file):
        with pytest.raises(HyrfFormatError, match="the run has not finished"):
            call(tmp_path)


def test_a_manifest_that_may_not_be_read_is_a_clear_error(tmp_path, monkeypatch):
    shutil.copytree(GOLDEN_SCENE_FOLDER, tmp_path, dirs_exist_ok=True)
    manifest = tmp_path / "scene.json"
    monkeypatch.setattr(run_folder_module, "is_scene_manifest", lambda _: False)
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != manifest or mode != os.R_OK)

    with pytest.raises(HyrfFormatError, match="scene.json: permission to read the file is denied; check its"):
        find_model(tmp_path)


@pytest.mark.parametrize("text", ["", '{"metadata": {"version": 4.5}}'])
def test_a_manifest_of_another_program_is_named_as_none_of_a_scene(tmp_path, text):
    (tmp_path / "scene.json").write_text(text)

    for call in (find_model, hyrfpack.load_model, hyrfpack.describe_file):
        with pytest.raises(HyrfFormatError, match="scene.json: this is not the manifest of a scene folder, and there"):
            call(tmp_path)
    with pytest.raises(HyrfFormatError, match="scene.json: "):
        hyrfpack.load_model(tmp_path / "scene.json")


def test_another_folder_is_refused_with_what_to_specify(tmp_path):
    with pytest.raises(HyrfFormatError, match="holds no model.hyrf; name a .hyrf file, or a folder that"):
        find_model(tmp_path)
    assert not is_run_folder(tmp_path)


def test_a_folder_that_may_not_be_read_is_a_clear_error(run_folder, monkeypatch):
    deny_access(monkeypatch, run_folder)
    assert not is_run_folder(run_folder)
    with pytest.raises(HyrfFormatError, match="permission to read the folder is denied; check its permissions"):
        find_model(run_folder)


def test_an_unfinished_run_is_refused_with_its_step_and_how_to_resume(unfinished_folder):
    with pytest.raises(HyrfFormatError, match=r"not finished \(step 120 of 3,000\); finish it .* with `resume=True`"):
        find_model(unfinished_folder)


def test_the_step_of_a_distributed_run_counts_the_steps_of_one_process(tmp_path):
    write_checkpoint(tmp_path, 7, {"steps": 100, "processes": 3})
    status = read_run_status(tmp_path)
    assert (status.step, status.steps) == (7, 34)


@pytest.mark.parametrize("seconds", ["1" + 400 * "0", "NaN", "Infinity", "true", "[]"])
def test_a_time_that_is_no_finite_number_is_unknown(seconds, tmp_path):
    (tmp_path / "metrics.json").write_text(f'{{"seconds": {seconds}}}')
    assert read_run_status(tmp_path).seconds is None


def test_a_run_with_a_damaged_checkpoint_is_reported_as_unfinished(tmp_path):
    (tmp_path / "checkpoint.pt").write_bytes(b"PK damaged")
    with pytest.raises(HyrfFormatError, match="the run has not finished; finish it"):
        find_model(tmp_path)


@pytest.mark.parametrize(
    "call",
    [
        hyrfpack.load_model,
        hyrfpack.describe_file,
        lambda run_folder: hyrfpack.compress_model(run_folder, "x.hyrf"),
        lambda run_folder: hyrfpack.export_model(run_folder, "x.ply"),
        lambda run_folder: hyrfpack.format.repack(run_folder, "x.hyrf"),
        lambda run_folder: hyrfpack.train.load_training_scene(run_folder),
    ],
    ids=["load", "describe", "compress", "export", "repack", "load_training_scene"],
)
def test_every_function_reports_an_unfinished_run(call, unfinished_folder, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(HyrfFormatError, match="step 120 of 3,000"):
        call(unfinished_folder)
    assert [path.name for path in tmp_path.iterdir()] == ["early"]


@pytest.mark.acceptance
def test_reading_a_run_equals_reading_its_model(run_folder, tmp_path):
    assert len(hyrfpack.load_model(run_folder)) == len(GAUSSIAN_POSITIONS)
    assert hyrfpack.describe_file(run_folder) == hyrfpack.describe_file(run_folder / "model.hyrf")
    hyrfpack.compress_model(run_folder, tmp_path / "a.hyrf", hyrfpack.CompressConfig(profile="paper"))
    hyrfpack.compress_model(run_folder / "model.hyrf", tmp_path / "b.hyrf", hyrfpack.CompressConfig(profile="paper"))
    assert (tmp_path / "a.hyrf").read_bytes() == (tmp_path / "b.hyrf").read_bytes()
    hyrfpack.export_model(run_folder, tmp_path / "a.ply", hyrfpack.ExportConfig(degree=0, background=False))
    assert len(read_splats(tmp_path / "a.ply")) == len(GAUSSIAN_POSITIONS)


def test_the_model_of_a_run_is_never_overwritten_by_its_own_output(run_folder):
    before = (run_folder / "model.hyrf").read_bytes()
    for write in (hyrfpack.format.repack, hyrfpack.compress_model):
        with pytest.raises(hyrfpack.HyrfError, match="the output is an input itself"):
            write(run_folder, run_folder / "model.hyrf")
    assert (run_folder / "model.hyrf").read_bytes() == before


def test_a_player_of_a_run_has_its_name_and_model(run_folder, tmp_path):
    hyrfpack.export_player(run_folder, tmp_path / "player")
    hyrfpack.export_gallery([run_folder, run_folder], tmp_path / "gallery")
    assert (tmp_path / "player" / "scene.hyrf").read_bytes() == (run_folder / "model.hyrf").read_bytes()
    assert sorted(path.name for path in (tmp_path / "gallery").glob("*.hyrf")) == ["bonsai-2.hyrf", "bonsai.hyrf"]


def test_the_status_of_a_finished_run_comes_from_its_metrics(run_folder):
    status = read_run_status(run_folder)
    assert status.finished and not status.has_checkpoint
    assert (status.step, status.steps, status.seconds) == (1200, 1200, 12.5)
    assert (status.photos, status.train, status.test) == ("photos/bonsai", 7, 2)
    assert (status.psnr, status.psnr_consistent, status.ssim) == (25.5, 21.25, 0.75)


def test_a_run_with_a_model_and_a_checkpoint_is_unfinished(run_folder):
    write_checkpoint(run_folder, 300, {"steps": 1200})
    assert not read_run_status(run_folder).finished and read_run_status(run_folder).step == 300
    assert find_model(run_folder) == run_folder / "model.hyrf"


@pytest.mark.parametrize("metrics", ["", "[]", '{"settings": 3, "evaluation": {"psnr": "NaN"}}', '{"seconds": NaN}'])
def test_damaged_metrics_give_an_unknown_status(metrics, run_folder):
    (run_folder / "metrics.json").write_text(metrics)
    status = read_run_status(run_folder)
    assert status.finished and status.steps is status.psnr is status.seconds is None

"""Which model a path names, and what is told of a run that has not finished."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from scenes import small_model

import hyrfpack
from hyrfpack.errors import HyrfFormatError
from hyrfpack.format.run_folder import find_model, is_run_folder, read_run_status
from hyrfpack.splats.files import read_splats
from hyrfpack.train.checkpoint import save_checkpoint

POSITIONS = [[0.0, 0, 0], [0.3, 0, 0]]


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """The folder of a finished run of 1,200 steps, by what metrics.json of `hyrfpack train` holds."""
    folder = tmp_path / "bonsai"
    hyrfpack.save_model(small_model(POSITIONS), folder / "model.hyrf")
    metrics = {
        "settings": {"steps": 1200},
        "scene": {"path": "photos/bonsai", "train": 7, "test": 2},
        "seconds": 12.5,
        "evaluation": {"psnr": 25.5, "psnr_consistent": 21.25, "ssim": 0.75},
    }
    (folder / "metrics.json").write_text(json.dumps(metrics))
    return folder


@pytest.fixture
def unfinished(tmp_path: Path) -> Path:
    """The folder of a run that was interrupted at step 120 of 3,000."""
    folder = tmp_path / "early"
    folder.mkdir()
    interrupt(folder, 120, {"steps": 3000})
    return folder


def interrupt(folder: Path, step: int, settings: dict) -> None:
    tensors = {"model.positions": torch.zeros(50, 3)}
    save_checkpoint(folder / "checkpoint.pt", settings=settings, tensors=tensors, progress={"step": step})


def test_a_file_names_itself_and_a_run_its_model(run):
    assert find_model(run) == run / "model.hyrf" and find_model(str(run)) == run / "model.hyrf"
    assert find_model("elsewhere/a.hyrf") == Path("elsewhere/a.hyrf")


def test_a_folder_that_is_no_run_is_refused_with_what_to_name(tmp_path):
    with pytest.raises(HyrfFormatError, match="holds no model.hyrf; name a .hyrf file, or a folder that"):
        find_model(tmp_path)
    assert not is_run_folder(tmp_path)


def test_an_unfinished_run_is_refused_with_its_step_and_how_to_finish_it(unfinished):
    with pytest.raises(HyrfFormatError, match=r"not finished \(step 120 of 3,000\); finish it .* with `resume=True`"):
        find_model(unfinished)


def test_steps_of_several_processes_are_those_that_each_takes(tmp_path):
    interrupt(tmp_path, 7, {"steps": 100, "processes": 3})
    status = read_run_status(tmp_path)
    assert (status.step, status.steps) == (7, 34)


def test_a_damaged_checkpoint_still_says_that_the_run_has_not_finished(tmp_path):
    (tmp_path / "checkpoint.pt").write_bytes(b"PK damaged")
    with pytest.raises(HyrfFormatError, match="the run has not finished; finish it"):
        find_model(tmp_path)


@pytest.mark.parametrize(
    "call",
    [
        hyrfpack.load_model,
        hyrfpack.describe_file,
        lambda run: hyrfpack.compress_model(run, "x.hyrf"),
        lambda run: hyrfpack.export_model(run, "x.ply"),
        lambda run: hyrfpack.format.repack(run, "x.hyrf"),
        lambda run: hyrfpack.train.load_training_scene(run),
    ],
    ids=["load", "describe", "compress", "export", "repack", "load_training_scene"],
)
def test_every_function_says_that_a_run_has_not_finished(call, unfinished, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(HyrfFormatError, match="step 120 of 3,000"):
        call(unfinished)
    assert [path.name for path in tmp_path.iterdir()] == ["early"]


def test_a_run_reads_as_its_model_does(run, tmp_path):
    assert len(hyrfpack.load_model(run)) == len(POSITIONS)
    assert hyrfpack.describe_file(run) == hyrfpack.describe_file(run / "model.hyrf")
    hyrfpack.compress_model(run, tmp_path / "a.hyrf", "paper")
    hyrfpack.compress_model(run / "model.hyrf", tmp_path / "b.hyrf", "paper")
    assert (tmp_path / "a.hyrf").read_bytes() == (tmp_path / "b.hyrf").read_bytes()
    hyrfpack.export_model(run, tmp_path / "a.ply", degree=0, background=False)
    assert len(read_splats(tmp_path / "a.ply")) == len(POSITIONS)


def test_the_model_of_a_run_that_is_read_is_never_replaced(run):
    before = (run / "model.hyrf").read_bytes()
    for write in (hyrfpack.format.repack, hyrfpack.compress_model):
        with pytest.raises(hyrfpack.HyrfError, match="the output is an input itself"):
            write(run, run / "model.hyrf")
    assert (run / "model.hyrf").read_bytes() == before


def test_a_player_of_a_run_has_its_name_and_its_model(run, tmp_path):
    hyrfpack.export_player(run, tmp_path / "player")
    hyrfpack.export_gallery([run, run], tmp_path / "gallery")
    assert (tmp_path / "player" / "scene.hyrf").read_bytes() == (run / "model.hyrf").read_bytes()
    assert sorted(path.name for path in (tmp_path / "gallery").glob("*.hyrf")) == ["bonsai-2.hyrf", "bonsai.hyrf"]


def test_the_status_of_a_finished_run_is_what_its_metrics_say(run):
    status = read_run_status(run)
    assert status.finished and not status.has_checkpoint
    assert (status.step, status.steps, status.seconds) == (1200, 1200, 12.5)
    assert (status.photos, status.train, status.test) == ("photos/bonsai", 7, 2)
    assert (status.psnr, status.psnr_consistent, status.ssim) == (25.5, 21.25, 0.75)


def test_a_run_with_a_model_and_a_checkpoint_is_not_finished(run):
    interrupt(run, 300, {"steps": 1200})
    assert not read_run_status(run).finished and read_run_status(run).step == 300
    assert find_model(run) == run / "model.hyrf"


@pytest.mark.parametrize("metrics", ["", "[]", '{"settings": 3, "evaluation": {"psnr": "NaN"}}', '{"seconds": NaN}'])
def test_damaged_metrics_leave_the_status_open(metrics, run):
    (run / "metrics.json").write_text(metrics)
    status = read_run_status(run)
    assert status.finished and status.steps is status.psnr is status.seconds is None

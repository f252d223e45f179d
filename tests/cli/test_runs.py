"""Folders of training runs in place of models, and errors as JSON."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from commands import hyrfpack, refused, succeeded

from hyrfpack.train.checkpoint import save_checkpoint


@pytest.fixture(scope="module")
def run(data, tmp_path_factory) -> Path:
    """A run of three steps."""
    folder = tmp_path_factory.mktemp("runs") / "bonsai"
    succeeded("train", data, "-o", folder, "--steps", 3, "--max-gaussians", 60)
    return folder


@pytest.fixture
def unfinished(tmp_path) -> Path:
    folder = tmp_path / "early"
    folder.mkdir()
    tensors = {"model.positions": torch.zeros(5, 3)}
    save_checkpoint(folder / "checkpoint.pt", settings={"steps": 3000}, tensors=tensors, progress={"step": 120})
    return folder


COMMANDS_THAT_READ_MODELS = {
    "compress": ("compress", "{run}", "-o", "{out}/a.hyrf", "--profile", "paper"),
    "decompress": ("decompress", "{run}", "-o", "{out}/a.hyrf"),
    "render": ("render", "{run}", "-o", "{out}/pictures", "--orbit", "1"),
    "evaluate": ("evaluate", "{run}", "--data", "{data}"),
    "export": ("export", "{run}", "-o", "{out}/a.ply", "--sh-degree", "0"),
    "player": ("export", "{run}", "-o", "{out}/player"),
    "gallery": ("export", "{run}", "{run}", "-o", "{out}/gallery"),
}


def fill_paths(words, run: Path, data: Path, out: Path) -> list[str]:
    return [word.format(run=run, data=data, out=out) for word in words]


@pytest.mark.parametrize("name", COMMANDS_THAT_READ_MODELS)
def test_every_command_accepts_a_run_folder_as_a_model(name, run, data, tmp_path):
    succeeded(*fill_paths(COMMANDS_THAT_READ_MODELS[name], run, data, tmp_path))


@pytest.mark.parametrize("name", [*COMMANDS_THAT_READ_MODELS, "view", "bench"])
def test_every_command_reports_an_unfinished_run(name, unfinished, data, tmp_path):
    words = COMMANDS_THAT_READ_MODELS.get(name) or (name, "{run}", *(("--no-browser",) if name == "view" else ()))
    messages = refused(*fill_paths(words, unfinished, data, tmp_path / "out"))
    assert "the run has not finished (step 120 of 3,000); finish it" in messages and "--resume" in messages
    assert not (tmp_path / "out").exists()


def test_the_model_of_a_run_is_never_replaced_by_its_own_output(run):
    before = (run / "model.hyrf").read_bytes()
    for command in ("compress", "decompress"):
        assert "input itself" in refused(command, run, "-o", run / "model.hyrf", "--overwrite")
    assert (run / "model.hyrf").read_bytes() == before


def test_info_of_a_run_prints_its_steps_scores_and_model(run, data):
    facts = json.loads(succeeded("info", run, "--json").stdout)
    metrics = json.loads((run / "metrics.json").read_text())
    assert facts["run"]["finished"] and facts["run"]["steps"] == 3 and not facts["run"]["has_checkpoint"]
    assert facts["run"]["psnr"] == metrics["evaluation"]["psnr"] and facts["gaussians"] == metrics["gaussians"]
    printed = succeeded("info", run).stdout
    assert printed.startswith(f"{run}: a finished training run: 3 steps")
    assert f"held-out photos: PSNR {metrics['evaluation']['psnr']:.2f} dB" in printed
    assert f"{run / 'model.hyrf'}: " in printed and "sharpness" not in printed


def test_info_of_an_unfinished_run_prints_its_progress(unfinished):
    printed = succeeded("info", unfinished).stdout
    assert printed.startswith(f"{unfinished}: the run has not finished (step 120 of 3,000)")
    facts = json.loads(succeeded("info", unfinished, "--json").stdout)["run"]
    assert not facts["finished"] and facts["has_checkpoint"] and (facts["step"], facts["steps"]) == (120, 3000)


# -- errors as JSON ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "arguments",
    [
        ("info", "missing.hyrf"),  # an error of the library
        ("compress", "missing.hyrf", "-o", "a.hyrf"),
        ("convert", "missing.ply", "a.spz"),
        ("train", "missing", "-o", "run"),
        ("make", "missing", "-o", "a.html"),
        ("info", "a.hyrf", "--no-such-option"),  # an error of click
        ("render", "a.hyrf"),
        ("export", "a.hyrf", "-o", "a.ply", "--crop", "1,2"),
        ("no-such-command",),
    ],
    ids=" ".join,
)
def test_an_error_under_json_is_an_object_on_stdout_and_a_line_on_stderr(arguments, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    plain, result = hyrfpack(*arguments), hyrfpack(*arguments, "--json")
    assert plain.exit_code == result.exit_code == 2 and plain.stdout == ""
    (sentence,) = [line for line in result.stderr.splitlines() if line.startswith("Error: ")]
    assert json.loads(result.stdout) == {"error": sentence.removeprefix("Error: ")}


def test_errors_under_json_and_quiet_are_the_same(tmp_path):
    result = hyrfpack("info", tmp_path / "missing.hyrf", "--json", "--quiet")
    assert result.exit_code == 2 and "missing.hyrf" in json.loads(result.stdout)["error"]


def test_view_prints_its_address_as_json(run):
    command = [sys.executable, "-m", "hyrfpack", "view", str(run), "--no-browser", "--json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process:
        lines = [process.stdout.readline() for _ in range(3)]
        process.terminate()  # SIGINT is ignored where the tests run in the background
    assert json.loads("".join(lines))["address"].startswith("http://127.0.0.1:")

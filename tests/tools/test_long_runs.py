"""The queue of long training runs keeps finished runs and skips those that another call trains."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
from scenes import QUIET_CONTEXT, ball_scene

from hyrfpack.lock import exclusive_folder
from hyrfpack.train import TrainResult
from tools.studies import long_runs, reuse
from tools.studies.reuse import describe_origin, write_origin
from tools.studies.train_sets import DATA_FOLDER


@pytest.fixture
def run_tool(monkeypatch, tmp_path, capsys):
    """A function that runs the tool on a synthetic scene and returns what it prints."""
    scene = ball_scene(views=10, points=60, side=24)
    scene = replace(scene, train=scene.train[2:], test=scene.train[:2])
    monkeypatch.setattr(long_runs, "load_variant", lambda data, name: scene)

    def run(*options: str) -> str:
        arguments = ["long_runs", "--steps", "40", "20", "--sets", "ball", "--out", str(tmp_path), *options]
        monkeypatch.setattr("sys.argv", arguments)
        long_runs.main()
        return capsys.readouterr().out

    return run


def test_the_queue_trains_short_runs_first_and_each_run_once(run_tool, tmp_path):
    first = run_tool()
    trained = [line.rsplit("/", 3)[1] for line in first.splitlines() if " to " in line]
    assert trained == ["20", "40"]

    path = tmp_path / "20/seed0/ball/measured.json"
    row = json.loads(path.read_text())
    assert row["compact"]["bytes"] == (path.parent / "compact.hyrf").stat().st_size
    assert row["compact"]["psnr"] == pytest.approx(row["psnr"], abs=1)
    again = run_tool()
    assert " to " not in again and again == first[first.index("| set") :]


def test_a_run_that_another_call_trains_is_skipped(run_tool, tmp_path):
    with exclusive_folder(tmp_path / "20/seed0/ball.queue"):
        printed = run_tool()
    assert not (tmp_path / "20/seed0/ball").exists()
    assert (tmp_path / "40/seed0/ball/measured.json").exists()
    assert "another" in printed


@pytest.mark.parametrize("left", ["checkpoint.pt", "pilot.pt", "teacher-1.hyrf"])
def test_a_stopped_run_resumes_from_what_it_has_left(run_tool, monkeypatch, left):
    train, resumed = long_runs.hyrfpack.train_model, []

    def stop_once(scene, folder, config, *, resume, **options):
        resumed.append(resume)
        if len(resumed) == 1:
            (folder / left).touch()
            return TrainResult(False, 5, None, {})
        (folder / left).unlink(missing_ok=True)
        return train(scene, folder, config, context=QUIET_CONTEXT)

    monkeypatch.setattr(long_runs.hyrfpack, "train_model", stop_once)
    with pytest.raises(SystemExit, match="the training was stopped, so it is not measured"):
        run_tool()
    run_tool()
    assert resumed == [False, True, False]


def test_a_run_of_another_version_is_named_and_neither_repeated_nor_resumed(run_tool, tmp_path, monkeypatch):
    run_tool()
    (tmp_path / "40/seed0/ball/measured.json").unlink()
    monkeypatch.setattr(reuse, "describe_own_version", lambda: "another")
    monkeypatch.setattr(long_runs.hyrfpack, "train_model", None)
    monkeypatch.setattr(long_runs, "load_variant", None)
    printed = run_tool()
    for steps in (20, 40):
        assert f"{tmp_path}/{steps}/seed0/ball: this run is not one of the same version" in printed
    assert printed.count("now another") == 2


def test_a_finished_run_gets_the_fine_tuned_file_that_is_asked_for(run_tool, tmp_path, monkeypatch):
    tuned = []

    def compress(folder, scene, profile, finetune_steps=None):
        tuned.append(finetune_steps)
        return {"bytes": 1234, "psnr": 20.0, "ssim": 0.5}

    monkeypatch.setattr(long_runs, "_compress_and_score", compress)
    row = {"name": "ball", "seed": 0, "exposure": None, "gains": False, "gaussians": 9, "seconds": 1.0}
    row |= {name: 20.0 for name in ("psnr", "ssim", "training_psnr")}
    row |= {profile: {"bytes": 1, "psnr": 20.0, "ssim": 0.5} for profile in ("raw", "paper", "compact")}
    for steps in (20, 40):
        folder = tmp_path / f"{steps}/seed0/ball"
        folder.mkdir(parents=True)
        write_origin(folder, describe_origin(DATA_FOLDER / "ball", name="ball", steps=steps, seed=0, exposure=None))
        (folder / "measured.json").write_text(json.dumps(row | {"steps": steps, "steps_taken": steps}))
    assert "1,234" in run_tool("--finetune", "5") and tuned == [5, 5]
    assert "1,234" in run_tool("--finetune", "5") and tuned == [5, 5]
    run_tool("--finetune", "7")
    assert tuned == [5, 5, 7, 7]

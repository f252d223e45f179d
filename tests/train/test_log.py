"""The log that a training run writes for programs."""

from __future__ import annotations

import json
import math
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from scenes import QUIET_CONTEXT, ball_scene

from hyrfpack.errors import HyrfError
from hyrfpack.progress import StepEvent
from hyrfpack.scene import Scene
from hyrfpack.train import TrainConfig, log, train_model
from hyrfpack.train.log import TrainingLog, peak_memory
from hyrfpack.train.trainer import MIN_CURVE_RECORDS

CPU_DEVICE = torch.device("cpu")
LOGGED_CONFIG = TrainConfig(steps=30, seed=1, max_gaussians=120, checkpoint_every=1)


def make_scene() -> Scene:
    scene = ball_scene(views=8, points=60, side=24)
    return replace(scene, train=scene.train[2:], test=scene.train[:2])


def read_log(path: Path) -> list[dict]:
    """Return the records of a log; NaN and infinity are not valid JSON."""

    def refuse(name: str) -> None:
        raise AssertionError(f"{name} in the log")

    return [json.loads(line, parse_constant=refuse) for line in path.read_text().splitlines()]


def test_each_log_line_reports_progress_and_the_last_one_the_results(tmp_path: Path) -> None:
    result = train_model(
        make_scene(), tmp_path / "run", LOGGED_CONFIG, context=QUIET_CONTEXT, log=tmp_path / "new" / "log.jsonl"
    )

    *steps, end = read_log(tmp_path / "new" / "log.jsonl")
    assert [record["step"] for record in steps] == list(range(1, LOGGED_CONFIG.steps + 1))
    for record in steps:
        assert record["event"] == "step" and record["steps"] == LOGGED_CONFIG.steps
        assert record["loss"] > 0 and record["psnr"] > 0 and record["gpu_memory_bytes"] is None
    curve = {record["step"]: record for record in result.metrics["curve"]}
    assert all(math.isclose(r["psnr"], curve[r["step"]]["psnr"], rel_tol=1e-5) for r in steps if r["step"] in curve)
    assert steps[-1]["seconds_left"] == 0 and steps[-1]["gaussians"] == result.metrics["gaussians"]
    scores = result.metrics["evaluation"]
    assert end["event"] == "end" and end["complete"] and end["bytes"] == result.model.stat().st_size
    assert (end["psnr"], end["ssim"]) == pytest.approx((scores["psnr"], scores["ssim"]), rel=1e-5)


def test_a_long_run_logs_few_records_of_means(tmp_path: Path) -> None:
    steps = 5 * MIN_CURVE_RECORDS
    with TrainingLog(tmp_path / "log.jsonl", steps, 0, CPU_DEVICE) as written:
        for step in range(1, steps + 1):
            written.step(StepEvent(step, steps, step, 0.01 if step % 2 else math.nan, 7))

    records = read_log(tmp_path / "log.jsonl")
    assert len(records) == MIN_CURVE_RECORDS
    assert records[0]["loss"] == 3 and records[0]["psnr"] == pytest.approx(20)  # the mean of steps 1, 3 and 5
    assert records[1]["loss"] == 8  # the mean of steps 7 and 9


def test_a_slow_run_is_logged_every_few_seconds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr(log.time, "monotonic", lambda: now[0])
    with TrainingLog(tmp_path / "log.jsonl", 10**6, 0, CPU_DEVICE) as written:
        for step in range(1, 13):
            now[0] += 2.5
            written.step(StepEvent(step, 10**6, 1.0, 0.1, 7))

    assert [record["step"] for record in read_log(tmp_path / "log.jsonl")] == [4, 8, 12]


def test_the_psnr_of_a_completely_masked_photo_is_null(tmp_path: Path) -> None:
    with TrainingLog(tmp_path / "log.jsonl", 2, 0, CPU_DEVICE) as written:
        written.step(StepEvent(1, 2, math.nan, math.nan, 7))
        written.step(StepEvent(2, 2, 0.0, 0.0, 7))

    first, second = read_log(tmp_path / "log.jsonl")
    assert first["loss"] is first["psnr"] is None and second["loss"] == 0 and second["psnr"] == 100


def test_a_resumed_run_appends_to_its_log_and_a_new_run_replaces_it(tmp_path: Path) -> None:
    where, file = tmp_path / "run", tmp_path / "log.jsonl"
    stop = iter([False] * 9 + [True])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("hyrfpack.train.trainer.Trainer._record", lambda *_: next(stop) and _interrupt())
        with pytest.raises(KeyboardInterrupt):
            train_model(make_scene(), where, LOGGED_CONFIG, context=QUIET_CONTEXT, log=file)
    train_model(make_scene(), where, LOGGED_CONFIG, context=QUIET_CONTEXT, log=file, resume=True)

    steps = [record["step"] for record in read_log(file) if record["event"] == "step"]
    assert steps == [*range(1, 10), *range(10, LOGGED_CONFIG.steps + 1)]
    with pytest.raises(HyrfError, match="log"):
        train_model(make_scene(), tmp_path / "other", LOGGED_CONFIG, context=QUIET_CONTEXT, log=file)
    train_model(make_scene(), tmp_path / "other", TrainConfig(steps=2), context=QUIET_CONTEXT, log=file, overwrite=True)
    assert [record["step"] for record in read_log(file)] == [1, 2, 2]


@pytest.mark.parametrize("earlier", ["", '{"step": 1}\n', '{"step": 1}\n{"st'])
def test_a_resumed_log_does_not_continue_a_line_that_was_cut_off(tmp_path: Path, earlier: str) -> None:
    file = tmp_path / "log.jsonl"
    file.write_text(earlier)
    with TrainingLog(file, 2, 1, CPU_DEVICE) as written:
        written.end(complete=False, step=1)

    *kept, last = file.read_text().splitlines()
    assert kept == earlier.splitlines() and json.loads(last)["event"] == "end"


def _interrupt() -> None:
    raise KeyboardInterrupt


def test_a_failed_run_logs_the_reason(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object, **__: object) -> None:
        raise HyrfError("it is broken", fix="repair it")

    monkeypatch.setattr("hyrfpack.train.trainer.Trainer._train_step", fail)
    with pytest.raises(HyrfError):
        train_model(make_scene(), tmp_path / "run", LOGGED_CONFIG, context=QUIET_CONTEXT, log=tmp_path / "log.jsonl")

    assert read_log(tmp_path / "log.jsonl") == [{"event": "end", "complete": False, "error": "it is broken; repair it"}]


def test_a_log_that_cannot_be_written_is_an_error_before_the_first_step(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(HyrfError, match="file"):
        train_model(
            make_scene(), tmp_path / "run", LOGGED_CONFIG, context=QUIET_CONTEXT, log=tmp_path / "file" / "log.jsonl"
        )
    assert not (tmp_path / "run" / "model.hyrf").exists()


def test_the_error_of_a_log_that_cannot_be_written_names_the_setting(tmp_path: Path) -> None:
    with pytest.raises(HyrfError, match="the log cannot be written.*name another file with `log`"):
        TrainingLog(tmp_path, 2, 0, CPU_DEVICE)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no /dev/full")
def test_a_full_disk_ends_the_log_and_not_the_run(caplog: pytest.LogCaptureFixture) -> None:
    with TrainingLog(Path("/dev/full"), 3, 0, CPU_DEVICE) as written:
        for step in (1, 2, 3):
            written.step(StepEvent(step, 3, 1.0, 0.1, 7))
        written.end(complete=True, step=3)
    assert len(caplog.messages) == 1 and "training continues without it" in caplog.messages[0]


def test_scalars_are_written_to_tensorboard_where_it_is_installed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scalars: dict[str, list[tuple[int, float]]] = {}

    class Writer:
        def __init__(self, folder: str, purge_step: int) -> None:
            assert (folder, purge_step) == (str(tmp_path / "log.tensorboard"), 1)

        def add_scalar(self, name: str, value: float, step: int) -> None:
            scalars.setdefault(name, []).append((step, value))

        def close(self) -> None:
            scalars["closed"] = []

    monkeypatch.setattr(log, "find_spec", lambda name: name == "tensorboard")
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", SimpleNamespace(SummaryWriter=Writer))
    with TrainingLog(tmp_path / "log.jsonl", 2, 0, CPU_DEVICE) as written:
        written.step(StepEvent(1, 2, 0.5, 0.1, 7))
        written.step(StepEvent(2, 2, 0.25, 0.01, 8))
        written.end(complete=True, step=2, psnr=21.5, gaussians=8)

    assert scalars["train/loss"] == [(1, 0.5), (2, 0.25)] and scalars["train/gaussians"] == [(1, 7), (2, 8)]
    assert scalars["train/psnr"] == [(1, pytest.approx(10)), (2, pytest.approx(20))]
    assert scalars["held-out/psnr"] == [(2, 21.5)] and "closed" in scalars


@pytest.mark.parametrize("broken", ["__init__", "add_scalar", "close"])
def test_an_error_of_tensorboard_ends_its_scalars_and_not_the_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, broken: str
) -> None:
    class Writer:
        def __init__(self, folder: str, purge_step: int) -> None:
            fail_in("__init__")

        def add_scalar(self, name: str, value: float, step: int) -> None:
            fail_in("add_scalar")

        def close(self) -> None:
            fail_in("close")

    def fail_in(name: str) -> None:
        if name == broken:
            raise RuntimeError("the disk is full")

    monkeypatch.setattr(log, "find_spec", lambda name: name == "tensorboard")
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", SimpleNamespace(SummaryWriter=Writer))
    with TrainingLog(tmp_path / "log.jsonl", 2, 0, CPU_DEVICE) as written:
        written.step(StepEvent(1, 2, 0.5, 0.1, 7))
        written.step(StepEvent(2, 2, 0.25, 0.01, 8))
        written.end(complete=True, step=2, psnr=21.5)

    assert [record["event"] for record in read_log(tmp_path / "log.jsonl")] == ["step", "step", "end"]
    (message,) = caplog.messages
    assert message.startswith(f"{tmp_path / 'log.tensorboard'}: TensorBoard's files cannot be written")
    assert "(the disk is full)" in message


def test_memory_is_in_bytes() -> None:
    peak = peak_memory()
    assert peak is None or 50e6 < peak < 1e12

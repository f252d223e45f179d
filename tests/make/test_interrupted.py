"""After an interruption at any stage, by Ctrl-C or a kill, the same call resumes and ends with the same bytes."""

from __future__ import annotations

import errno
import os
import re
import shutil
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import pytest

from hyrfpack.atomic import TEMPORARY_PREFIX
from hyrfpack.config.make import MakeConfig
from hyrfpack.context import RunContext
from hyrfpack.errors import HyrfError, HyrfTrainingError
from hyrfpack.format.run_folder import PREVIEW_FILE
from hyrfpack.make import Stopped, make_scene, run, stages
from hyrfpack.make.stage_cache import interruptible
from hyrfpack.progress import StageEvent, StepEvent
from hyrfpack.train import TrainResult

pytestmark = pytest.mark.usefixtures("fake_stages")

# Stage -> the function of `stages` that does its work.
STAGE_FUNCTIONS = {
    "training": "train_model",
    "compression": "compress_model",
    "scoring": "evaluate_model",
    "export": "export_model",
}


def read_products(work: Path) -> dict[str, bytes]:
    names = ("model.hyrf", "run/model.hyrf", "export/scene.html")
    return {name: (work / name).read_bytes() for name in names}


@pytest.fixture
def uninterrupted_work(fake_stages, posed, tmp_path_factory) -> Path:
    """The work folder of an uninterrupted call."""
    return make_scene(posed, tmp_path_factory.mktemp("whole") / "scene.html").work


@pytest.fixture
def uninterrupted_products(uninterrupted_work) -> dict[str, bytes]:
    """The products of an uninterrupted call."""
    return read_products(uninterrupted_work)


@pytest.mark.parametrize("after", [False, True], ids=["before its work", "after it, before the record of it"])
def test_an_interrupt_in_each_stage_loses_no_work(after, uninterrupted_products, posed, tmp_path, monkeypatch, caplog):
    """Each call is stopped one stage later than the one before."""
    done: list[str] = []
    for stage, function in STAGE_FUNCTIONS.items():
        usual = getattr(stages, function)
        caplog.clear()

        def stop(*arguments, usual=usual, **options):
            if after:
                usual(*arguments, **options)
            raise KeyboardInterrupt

        with monkeypatch.context() as patch:
            patch.setattr(stages, function, stop)
            with pytest.raises(Stopped) as caught:
                make_scene(posed, tmp_path / "scene.html")
        assert caught.value.stage == stage and not (tmp_path / "scene.html").exists()
        trained = tmp_path / "scene.work" / "run" / "model.hyrf"
        assert caught.value.scene == (trained if function == "compress_model" else None)
        assert [
            name for name in STAGE_FUNCTIONS if any(f"{name}: reused from an earlier run" in s for s in caplog.messages)
        ] == done[:-1]
        done.append(stage)
    result = make_scene(posed, tmp_path / "scene.html")
    assert (
        read_products(result.work) == uninterrupted_products
        and result.output.read_bytes() == uninterrupted_products["export/scene.html"]
    )
    assert list(result.kept) == done[:-1]


def test_an_interrupt_between_two_stages_names_the_finished_one(posed, tmp_path, monkeypatch):
    def stop(stage_cache):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(run, "remove_preview", stop)
        with pytest.raises(Stopped, match="stopped in training"):
            make_scene(posed, tmp_path / "scene.html")
    assert make_scene(posed, tmp_path / "scene.html").kept == ("training",)


@contextmanager
def interrupted_when_closed(*arguments) -> Iterator[None]:
    """Stand in for a context manager during whose exit Ctrl-C is pressed."""
    try:
        yield
    finally:
        raise KeyboardInterrupt


def test_a_second_interrupt_keeps_the_stage_and_preview_of_the_first(posed, tmp_path, monkeypatch):
    def stop(*arguments, **options):
        raise Stopped("training", tmp_path / PREVIEW_FILE)

    monkeypatch.setattr(stages, "train_model", stop)
    monkeypatch.setattr(run, "exclusive_folder", interrupted_when_closed)
    with pytest.raises(Stopped, match="stopped in training") as stopped:
        make_scene(posed, tmp_path / "scene.html")
    assert stopped.value.scene == tmp_path / PREVIEW_FILE


def test_an_interrupt_after_all_stages_names_the_last_one(posed, tmp_path, monkeypatch):
    monkeypatch.setattr(run, "exclusive_folder", interrupted_when_closed)
    with pytest.raises(Stopped, match="stopped in export"):
        make_scene(posed, tmp_path / "scene.html")
    assert (tmp_path / "scene.html").is_file()


def test_an_interrupt_on_a_full_disk_is_still_an_interrupt(posed, tmp_path, monkeypatch):
    def fill_disk_and_stop(*arguments, **options):
        monkeypatch.setattr("hyrfpack.make.state.write_atomic", fail)
        raise KeyboardInterrupt

    def fail(path, data):
        raise HyrfError(f"{path}: the disk is full", fix="free some space")

    monkeypatch.setattr(stages, "train_model", fill_disk_and_stop)
    with pytest.raises(Stopped, match="stopped in training"):
        make_scene(posed, tmp_path / "scene.html")


def record_details(details: list[str]) -> RunContext:
    """Return a context that adds the most important description of each event to a list."""
    return RunContext(progress=lambda event: details.extend(event.details[:1]))


def test_an_interrupted_estimation_of_poses_resumes(photos, poses, tmp_path, monkeypatch):
    def stop(progress):
        raise KeyboardInterrupt

    with pytest.raises(Stopped, match="stopped in poses"):
        make_scene(photos, tmp_path / "scene.html", MakeConfig(quality="draft"), context=RunContext(progress=stop))
    assert make_scene(photos, tmp_path / "scene.html", MakeConfig(quality="draft")).kept == ()
    assert make_scene(photos, tmp_path / "scene.ply", MakeConfig(quality="draft")).kept[0] == "poses"


@pytest.mark.parametrize("copied", [2, 7])  # 7 are all but the scene, with the poster
def test_a_partly_copied_output_is_completed(copied, posed, tmp_path, monkeypatch):
    usual, copies = stages.copy_if_different, []

    def stop(source, target, **options):
        copies.append(target)
        if len(copies) > copied:
            raise KeyboardInterrupt
        usual(source, target, **options)

    with monkeypatch.context() as patch:
        patch.setattr(stages, "copy_if_different", stop)
        with pytest.raises(Stopped, match="stopped in export"):
            make_scene(posed, tmp_path / "player", MakeConfig(quality="draft"))
    assert len(list((tmp_path / "player").iterdir())) == copied
    completed = make_scene(posed, tmp_path / "player", MakeConfig(quality="draft")).output
    undisturbed = make_scene(posed, tmp_path / "other", MakeConfig(quality="draft")).output
    assert {path.name for path in completed.iterdir()} == {path.name for path in undisturbed.iterdir()}


def test_a_finished_folder_stays_as_it_is_when_the_call_is_repeated(finished_work, posed, tmp_path):
    output = make_scene(posed, tmp_path / "player", work=finished_work).output
    before = {path.name: path.stat().st_mtime_ns for path in output.iterdir()}
    assert "poster.jpg" in before
    assert make_scene(posed, output, work=finished_work).kept[-1] == "export"
    assert {path.name: path.stat().st_mtime_ns for path in output.iterdir()} == before


@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
def test_signals_interrupt_and_their_handlers_are_restored(name, signals):
    number = getattr(signal, name, signal.SIGTERM)
    before = signal.getsignal(number)
    with pytest.raises(KeyboardInterrupt), interruptible():
        signal.raise_signal(number)
    assert signal.getsignal(number) is before


@contextmanager
def file_limit(size: int) -> Iterator[None]:
    """Limit the size of files that this process writes, so that a write stops in the middle, as on a full disk."""
    resource = pytest.importorskip("resource", reason="limits are of Unix")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


@pytest.mark.parametrize(
    "changes, limit, sentence",
    [
        ({}, 500, "make.json: "),
        ({"seed": 1}, 6_000, "training failed: .*run/model.hyrf: "),
        ({"quality": "best"}, 6_000, "compression failed: .*model.hyrf: "),
        ({"output": "other.html"}, 20_000, "export failed: .*export/other.html: "),
        ({"output": "scene.html"}, 20_000, "scene.html: "),  # the copy to the output path
    ],
)
def test_a_full_disk_in_any_stage_is_a_clear_error_and_the_same_call_resumes(
    changes, limit, sentence, uninterrupted_work, posed, tmp_path
):
    work = tmp_path / "work"
    if limit > 500:
        shutil.copytree(uninterrupted_work, work)
    changes = {"output": "scene.html", **changes}
    output, config = tmp_path / changes.pop("output"), MakeConfig(**changes)
    with file_limit(limit), pytest.raises(HyrfError, match=f"{sentence}.*not allowed here"):
        make_scene(posed, output, config, work=work)
    assert not output.exists()
    assert make_scene(posed, output, config, work=work).output.exists()
    assert not [path for path in tmp_path.rglob("*") if path.name.startswith(TEMPORARY_PREFIX)]


def test_the_time_of_interrupted_and_killed_calls_is_included(posed, tmp_path, monkeypatch):
    clock = [0.0]
    monkeypatch.setattr("hyrfpack.make.stage_cache.monotonic", lambda: clock[0])

    def end(seconds: float, error: BaseException):
        def train(*arguments, **options):
            clock[0] += seconds
            options["context"].progress(StepEvent(1, 9, 0.1, 0.01, 500))  # this call records the time so far
            clock[0] += 5  # shorter than the interval between records
            raise error

        return train

    for seconds, error in ((100.0, KeyboardInterrupt()), (40.0, SystemExit("killed"))):
        with monkeypatch.context() as patch, pytest.raises((Stopped, SystemExit)):
            patch.setattr(stages, "train_model", end(seconds, error))
            make_scene(posed, tmp_path / "scene.html")
    result = make_scene(posed, tmp_path / "scene.html")
    assert result.seconds["training"] == 100 + 5 + 40 and result.total_seconds == sum(result.seconds.values())


def test_a_kill_at_any_report_loses_no_finished_work(uninterrupted_products, posed, tmp_path):
    """A copy of the work folder during a report is what a process that was killed there leaves."""
    killed: list[tuple[StageEvent, Path]] = []

    def copy_work(event: StageEvent) -> None:
        output = tmp_path / str(len(killed)) / "scene.html"
        shutil.copytree(tmp_path / "scene.work", output.with_suffix(".work"))
        killed.append((event, output))

    make_scene(posed, tmp_path / "scene.html", context=RunContext(progress=copy_work))
    for event, output in killed:
        words: list[str] = []
        again = make_scene(posed, output, context=record_details(words))
        assert again.kept == tuple(STAGE_FUNCTIONS)[: event.number - 1]
        if match := re.match(r"step (\d)/9", "".join(event.details[:1])):
            steps = [word for word in words if word.startswith("step ")]
            assert steps == [f"step {step}/9" for step in range(int(match[1]) + 1, 10)]
        assert read_products(again.work) == uninterrupted_products
    assert {event.stage for event, _ in killed} == set(STAGE_FUNCTIONS)


def stop_at_step_5(event: StageEvent) -> None:
    if event.details[:1] == ("step 5/9",):
        raise KeyboardInterrupt


def test_the_preview_of_an_interrupted_training_is_removed_when_the_training_is_finished(posed, tmp_path, monkeypatch):
    with pytest.raises(Stopped):
        make_scene(posed, tmp_path / "scene.html", context=RunContext(progress=stop_at_step_5))
    (tmp_path / "scene.work" / PREVIEW_FILE).write_bytes(b"the scene at step 5")
    assert not (make_scene(posed, tmp_path / "scene.html").work / PREVIEW_FILE).exists()


def test_a_preview_of_earlier_settings_is_removed_even_if_the_new_training_fails(posed, tmp_path, monkeypatch):
    with pytest.raises(Stopped):
        make_scene(posed, tmp_path / "scene.html", context=RunContext(progress=stop_at_step_5))
    preview = tmp_path / "scene.work" / PREVIEW_FILE
    preview.write_bytes(b"the scene at step 5")

    def fail(*arguments, **options):
        raise HyrfError("a photo cannot be read", fix="replace it")

    with monkeypatch.context() as patch:
        patch.setattr(stages, "train_model", fail)
        with pytest.raises(HyrfError, match="training failed: a photo cannot be read"):
            make_scene(posed, tmp_path / "scene.html", MakeConfig(seed=1))
    assert not preview.exists()
    assert make_scene(posed, tmp_path / "scene.html", MakeConfig(seed=1)).output.exists()


def test_interrupted_pilot_runs_leave_no_preview(posed, tmp_path, monkeypatch):
    def stop_in_pilots(scene, run, config, *, observer, **options) -> TrainResult:
        observer(SimpleNamespace(kind="pilot run", step=3, steps=120))
        return TrainResult(False, 0, None, {})

    monkeypatch.setattr(stages, "train_model", stop_in_pilots)
    monkeypatch.setattr(stages, "write_preview", lambda *arguments: pytest.fail("a pilot run was packed"))
    with pytest.raises(Stopped, match="training") as stopped:
        make_scene(posed, tmp_path / "scene.html")
    assert stopped.value.scene is None


@pytest.mark.parametrize(
    ("runs", "shown"),
    [
        ([("teacher run", 3)], ("teacher run", 3)),
        ([("teacher run", 1_000), ("teacher run", 3)], ("teacher run", 1_000)),
        ([("teacher run", 1_000), ("", 3)], ("teacher run", 1_000)),
        ([("teacher run", 1_000), ("", 1_000)], ("", 1_000)),
        ([("", 3)], ("", 3)),
        ([("teacher run", 1_000), ("", 3_000)], None),
    ],
)
def test_a_preview_shows_a_teacher_run_until_the_next_run_has_as_many_steps(runs, shown, posed, tmp_path, monkeypatch):
    previews: list[tuple[str, int]] = []

    def stop(scene, run, config, *, observer, **options) -> TrainResult:
        for kind, step in runs:
            observer(SimpleNamespace(kind=kind, step=step, steps=3_000))
        return TrainResult(False, 0, None, {})

    monkeypatch.setattr(stages, "train_model", stop)
    monkeypatch.setattr(stages, "write_preview", lambda _, trainer, __: previews.append((trainer.kind, trainer.step)))
    with pytest.raises(Stopped, match="training"):
        make_scene(posed, tmp_path / "scene.html")
    assert previews == ([] if shown is None else [shown])


@pytest.mark.parametrize("kinds", [("teacher run", ""), ("pilot run",)])
def test_an_error_of_a_resumed_training_keeps_its_advice_once_a_run_has_begun(posed, tmp_path, monkeypatch, kinds):
    with pytest.raises(Stopped):
        make_scene(posed, tmp_path / "scene.html", context=RunContext(progress=stop_at_step_5))

    def fail(scene, run, config, *, observer, **options) -> TrainResult:
        for kind in kinds:
            observer(SimpleNamespace(kind=kind, step=3, steps=3_000))
        raise HyrfTrainingError("the loss is not finite", fix="look at the photo")

    monkeypatch.setattr(stages, "train_model", fail)
    with pytest.raises(HyrfError, match="the loss is not finite; look at the photo"):
        make_scene(posed, tmp_path / "scene.html")


def test_a_checkpoint_that_cannot_be_used_comes_with_advice_that_works(posed, tmp_path, monkeypatch):
    with pytest.raises(Stopped):
        make_scene(posed, tmp_path / "scene.html", context=RunContext(progress=stop_at_step_5))

    def refuse(*arguments, **options):
        raise HyrfTrainingError("the checkpoint is of another version", fix="train anew with `overwrite=True`")

    run = tmp_path / "scene.work" / "run"
    with monkeypatch.context() as patch:
        patch.setattr(stages, "train_model", refuse)
        with pytest.raises(HyrfError, match=f"another version; delete {re.escape(str(run))} and run the same command"):
            make_scene(posed, tmp_path / "scene.html")
    shutil.rmtree(run)
    assert make_scene(posed, tmp_path / "scene.html").output.exists()


def test_an_interrupted_training_is_not_resumed_with_other_settings(posed, tmp_path):
    with pytest.raises(Stopped):
        make_scene(posed, tmp_path / "scene.html", context=RunContext(progress=stop_at_step_5))
    words: list[str] = []
    make_scene(posed, tmp_path / "scene.html", MakeConfig(seed=1), context=record_details(words))
    assert "step 1/9" in words


def test_missing_metrics_after_a_full_disk_are_completed_by_the_next_call(posed, tmp_path, monkeypatch):
    replace = os.replace

    def replace_on_full_disk(source, target) -> None:
        if str(target).endswith("metrics.json"):
            raise OSError(errno.ENOSPC, "No space left on device")
        replace(source, target)

    with monkeypatch.context() as patch:
        patch.setattr("hyrfpack.atomic.os.replace", replace_on_full_disk)
        with pytest.raises(HyrfError, match=r"training failed: .*metrics.json: the disk is full.*is kept"):
            make_scene(posed, tmp_path / "scene.html")
    run = tmp_path / "scene.work" / "run"
    assert (run / "model.hyrf").is_file() and not (run / "metrics.json").exists()

    words: list[str] = []
    result = make_scene(posed, tmp_path / "scene.html", context=record_details(words))
    assert result.output.is_file() and (run / "metrics.json").is_file()
    assert not any(word.startswith("step ") for word in words), "it was trained again"

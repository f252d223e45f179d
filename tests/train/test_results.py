"""A full disk or an interruption after the last step does not lose a training run's results."""

from __future__ import annotations

import dataclasses
import errno
import hashlib
import json
import os
from collections.abc import Callable
from pathlib import Path

import pytest
from scenes import QUIET_CONTEXT, ball_scene

from hyrfpack.context import RunContext
from hyrfpack.errors import HyrfDataError, HyrfError, HyrfTrainingError
from hyrfpack.outputs import StrPath
from hyrfpack.progress import Event, TaskEvent
from hyrfpack.scene import Scene
from hyrfpack.train import TrainConfig, Trainer, length_pilots, train_model
from hyrfpack.train import run as runs
from hyrfpack.train.results import RECORD_FILE, TrainingRecord, read_record

SHORT_CONFIG = TrainConfig(steps=8, seed=1, max_gaussians=120)
COMPLETE_RUN_FILES = {"model.hyrf", "metrics.json", "curve.png", "views"}
TIMING_KEYS = ("seconds", "steps_per_second", "stage_seconds")


def make_scene() -> Scene:
    """Return a scene of six training photos and two held-out photos."""
    scene = ball_scene(views=8, points=60, side=24)
    return dataclasses.replace(scene, train=scene.train[2:], test=scene.train[:2])


def file_names(out: Path) -> set[str]:
    return {path.name for path in out.iterdir()}


def read_metrics(out: Path) -> dict:
    return json.loads((out / "metrics.json").read_bytes())


@pytest.fixture
def full_disk_suffixes(monkeypatch) -> set[str]:
    """Suffixes of paths for which the disk has no space; a test fills and clears the set."""
    endings: set[str] = set()

    def checked(move: Callable[[StrPath, StrPath], None]) -> Callable[[StrPath, StrPath], None]:
        def checked_move(source: StrPath, target: StrPath) -> None:
            if str(target).endswith(tuple(endings)):
                raise OSError(errno.ENOSPC, "No space left on device")
            move(source, target)

        return checked_move

    for name in ("replace", "link"):
        monkeypatch.setattr(f"hyrfpack.atomic.os.{name}", checked(getattr(os, name)))
    return endings


@pytest.fixture
def fail_if_trained(monkeypatch):
    """A function after whose call any training fails the test."""
    return lambda: monkeypatch.setattr(Trainer, "run", lambda *_, **__: pytest.fail("it was trained again"))


@pytest.fixture(scope="module")
def uninterrupted_run(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "undisturbed"
    train_model(make_scene(), out, SHORT_CONFIG, context=QUIET_CONTEXT)
    return out


@pytest.mark.parametrize("resume", [pytest.param(False, marks=pytest.mark.acceptance), True])
def test_metrics_missing_after_a_full_disk_are_completed_without_training(
    full_disk_suffixes, fail_if_trained, uninterrupted_run, tmp_path, resume
):
    full_disk_suffixes.add("metrics.json")
    result = train_model(make_scene(), tmp_path, SHORT_CONFIG, context=QUIET_CONTEXT)
    assert result.complete and result.model.is_file() and result.metrics["evaluation"]["psnr"] > 0
    assert "metrics.json: the disk is full" in result.missing
    assert file_names(tmp_path) == {"model.hyrf", "curve.png", "views", "training.json"}
    times = {name: result.metrics[name] for name in TIMING_KEYS}

    full_disk_suffixes.clear()
    fail_if_trained()
    completed = train_model(make_scene(), tmp_path, SHORT_CONFIG, resume=resume, context=QUIET_CONTEXT)

    assert completed.complete and completed.step == 8 and completed.missing == ""
    assert file_names(tmp_path) == COMPLETE_RUN_FILES
    metrics, expected = read_metrics(tmp_path), read_metrics(uninterrupted_run)
    assert metrics == json.loads(json.dumps(completed.metrics)) and metrics.keys() == expected.keys()
    assert {name: metrics[name] for name in TIMING_KEYS} == times
    for key in ("settings", "choices", "scene", "gaussians", "bytes", "device", "processes", "notes"):
        assert metrics[key] == expected[key], key
    curves = [[{**r, "seconds": 0} for r in m["curve"]] for m in (metrics, expected)]
    assert curves[0] == curves[1]
    scores = [{**m["evaluation"], "seconds_per_frame": 0} for m in (metrics, expected)]
    assert scores[0] == scores[1]


@pytest.mark.parametrize(("ending", "missing"), [("curve.png", "curve.png"), (".png", "views and curve.png")])
def test_pictures_that_do_not_fit_do_not_fail_the_run(
    full_disk_suffixes, fail_if_trained, tmp_path, caplog, ending, missing
):
    full_disk_suffixes.add(ending)
    result = train_model(make_scene(), tmp_path, SHORT_CONFIG)
    assert result.complete and read_metrics(tmp_path) == json.loads(json.dumps(result.metrics))
    verb = "is" if ending == "curve.png" else "are"
    assert f"the model is finished, but {missing} {verb} missing" in caplog.messages[-1]
    assert caplog.messages[-1].count(".png: the disk is full") == len(missing.split(" and "))

    full_disk_suffixes.clear()
    fail_if_trained()
    train_model(make_scene(), tmp_path, SHORT_CONFIG, context=QUIET_CONTEXT)
    assert file_names(tmp_path) == COMPLETE_RUN_FILES and len(list((tmp_path / "views").iterdir())) == 2


def test_a_held_out_photo_that_is_gone_after_the_last_step_does_not_fail_the_run(fail_if_trained, tmp_path):
    scene, reads = make_scene(), [0]

    def vanishing():
        reads[0] += 1
        if reads[0] == 2:  # the first read comes before the first step
            raise HyrfDataError("photos/0000.png: the file is gone", fix="copy it again")
        return scene.train[0].load()

    test = [dataclasses.replace(scene.test[0], load=vanishing), scene.test[1]]
    result = train_model(dataclasses.replace(scene, test=test), tmp_path, SHORT_CONFIG, context=QUIET_CONTEXT)
    assert result.complete and "photos/0000.png: the file is gone" in result.missing
    assert not (tmp_path / "metrics.json").exists()

    fail_if_trained()
    train_model(make_scene(), tmp_path, SHORT_CONFIG, context=QUIET_CONTEXT)
    assert file_names(tmp_path) == COMPLETE_RUN_FILES


def test_an_interruption_while_scoring_is_completed_without_training(fail_if_trained, monkeypatch, tmp_path):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr("hyrfpack.train.results.evaluate_model", interrupted)
        train_model(make_scene(), tmp_path, SHORT_CONFIG, context=QUIET_CONTEXT)
    assert file_names(tmp_path) == {"model.hyrf", "training.json"} and runs.is_begun(tmp_path)

    fail_if_trained()
    train_model(make_scene(), tmp_path, SHORT_CONFIG, context=QUIET_CONTEXT)
    assert file_names(tmp_path) == COMPLETE_RUN_FILES and not runs.is_begun(tmp_path)


def test_a_model_that_does_not_fit_leaves_the_checkpoint_and_resuming_completes_the_run(
    full_disk_suffixes, uninterrupted_run, tmp_path
):
    full_disk_suffixes.add("model.hyrf")
    with pytest.raises(
        HyrfError, match=r"model.hyrf: the disk is full.*checkpoint of step 7 is kept.*`resume=True` continues"
    ):
        train_model(make_scene(), tmp_path, SHORT_CONFIG, context=QUIET_CONTEXT)
    assert file_names(tmp_path) == {"checkpoint.pt"}

    full_disk_suffixes.clear()
    train_model(make_scene(), tmp_path, SHORT_CONFIG, resume=True, context=QUIET_CONTEXT)
    assert file_names(tmp_path) == COMPLETE_RUN_FILES
    assert (tmp_path / "model.hyrf").read_bytes() == (uninterrupted_run / "model.hyrf").read_bytes()


def test_without_space_for_the_training_record_the_checkpoint_stays_until_metrics_exist(full_disk_suffixes, tmp_path):
    full_disk_suffixes |= {"training.json", "metrics.json"}
    result = train_model(make_scene(), tmp_path, SHORT_CONFIG, context=QUIET_CONTEXT)
    assert result.complete and file_names(tmp_path) == {"model.hyrf", "checkpoint.pt", "curve.png", "views"}

    full_disk_suffixes.clear()
    train_model(make_scene(), tmp_path, SHORT_CONFIG, resume=True, context=QUIET_CONTEXT)
    assert file_names(tmp_path) == COMPLETE_RUN_FILES and len(read_metrics(tmp_path)["curve"]) == 8


def test_without_space_for_the_training_record_the_checkpoint_stays_until_all_pictures_exist(
    full_disk_suffixes, tmp_path
):
    full_disk_suffixes |= {"training.json", ".png"}
    result = train_model(make_scene(), tmp_path, SHORT_CONFIG, context=QUIET_CONTEXT)
    assert "views and curve.png are missing" in result.missing
    assert {"model.hyrf", "checkpoint.pt", "metrics.json"} <= file_names(tmp_path)

    full_disk_suffixes.clear()
    train_model(make_scene(), tmp_path, SHORT_CONFIG, resume=True, context=QUIET_CONTEXT)
    assert file_names(tmp_path) == COMPLETE_RUN_FILES and len(list((tmp_path / "views").iterdir())) == 2


def test_results_are_completed_with_the_settings_of_the_model_only(full_disk_suffixes, tmp_path):
    full_disk_suffixes.add("metrics.json")
    train_model(make_scene(), tmp_path, SHORT_CONFIG, context=QUIET_CONTEXT)
    before = hashlib.sha256((tmp_path / "model.hyrf").read_bytes()).digest()
    full_disk_suffixes.clear()
    other = dataclasses.replace(SHORT_CONFIG, steps=10, seed=2)
    for resume in (False, True):
        with pytest.raises(HyrfTrainingError, match=r"other settings \(seed, steps\).*`overwrite=True`"):
            train_model(make_scene(), tmp_path, other, resume=resume, context=QUIET_CONTEXT)
    fewer = dataclasses.replace(make_scene(), test=make_scene().test[:1])
    with pytest.raises(HyrfTrainingError, match="other settings .held-out views."):
        train_model(fewer, tmp_path, SHORT_CONFIG, context=QUIET_CONTEXT)
    assert hashlib.sha256((tmp_path / "model.hyrf").read_bytes()).digest() == before

    train_model(make_scene(), tmp_path, other, overwrite=True, context=QUIET_CONTEXT)
    assert read_metrics(tmp_path)["settings"]["steps"] == 10 and file_names(tmp_path) == COMPLETE_RUN_FILES


def test_results_of_a_run_without_length_pilots_are_not_completed_with_more_steps(
    full_disk_suffixes, tmp_path, monkeypatch
):
    scene = ball_scene(views=10, points=60, side=24)
    full_disk_suffixes.add("curve.png")
    train_model(scene, tmp_path, TrainConfig(steps=8), context=QUIET_CONTEXT)
    monkeypatch.setattr(length_pilots, "PILOT_LENGTHS_STEPS", (8,))
    for resume in (False, True):
        with pytest.raises(HyrfTrainingError, match=r"other settings \(steps\)"):
            train_model(scene, tmp_path, TrainConfig(steps=20), resume=resume, context=QUIET_CONTEXT)


def test_pictures_of_an_earlier_run_do_not_stay_beside_those_of_other_held_out_photos(tmp_path):
    scene = make_scene()
    train_model(scene, tmp_path, SHORT_CONFIG, context=QUIET_CONTEXT)
    earlier = file_names(tmp_path / "views")
    (tmp_path / "views" / "notes.png").write_bytes(b"of the user")
    other = dataclasses.replace(scene, train=scene.train[2:] + scene.test, test=scene.train[:2])
    train_model(other, tmp_path, SHORT_CONFIG, overwrite=True, context=QUIET_CONTEXT)
    left = file_names(tmp_path / "views")
    assert "notes.png" in left and len(left) == 3 and not earlier & left


@pytest.mark.parametrize(
    "listed",
    [
        {"views": [{"name": "../../outside.png"}], "skipped": ["/outside.png"]},
        {"views": [{"name": "linked/outside.png"}], "skipped": []},
        {"views": [7], "skipped": None},
        *(
            pytest.param(listed, marks=pytest.mark.acceptance)
            for listed in ({"views": [{"name": 3}], "skipped": []}, [])
        ),
    ],
)
def test_a_hostile_list_of_earlier_pictures_removes_nothing_outside(tmp_path, listed):
    outside = tmp_path / "outside.png"
    outside.write_bytes(b"kept")
    out = tmp_path / "run"
    (out / "views").mkdir(parents=True)
    (out / "views" / "linked").symlink_to(tmp_path)
    (out / "metrics.json").write_text(json.dumps({"evaluation": listed}))
    train_model(make_scene(), out, SHORT_CONFIG, overwrite=True, context=QUIET_CONTEXT)
    assert outside.read_bytes() == b"kept" and "evaluation" in read_metrics(out)


def test_metrics_of_an_earlier_model_do_not_stay_beside_a_new_one(full_disk_suffixes, tmp_path):
    train_model(make_scene(), tmp_path, SHORT_CONFIG, context=QUIET_CONTEXT)
    full_disk_suffixes |= {"metrics.json", ".png"}
    result = train_model(
        make_scene(), tmp_path, dataclasses.replace(SHORT_CONFIG, seed=5), overwrite=True, context=QUIET_CONTEXT
    )
    assert "views, curve.png and metrics.json are missing" in result.missing
    assert file_names(tmp_path) == {"model.hyrf", "training.json", "views"} and not list((tmp_path / "views").iterdir())


@pytest.mark.parametrize(
    "damage",
    [
        None,
        *(pytest.param(damage, marks=pytest.mark.acceptance) for damage in (b"", b"[]", b"{}", b'{"version": 1}')),
    ],
)
def test_a_damaged_or_foreign_training_record_is_ignored(full_disk_suffixes, tmp_path, damage):
    full_disk_suffixes.add("metrics.json")
    train_model(make_scene(), tmp_path, SHORT_CONFIG, context=QUIET_CONTEXT)
    full_disk_suffixes.clear()
    if damage is None:
        (tmp_path / "model.hyrf").write_bytes(b"another")
    else:
        (tmp_path / "training.json").write_bytes(damage)
    with pytest.raises(HyrfError, match="holds an earlier run"):
        train_model(make_scene(), tmp_path, SHORT_CONFIG, context=QUIET_CONTEXT)
    with pytest.raises(HyrfError, match="no checkpoint to resume"):
        train_model(make_scene(), tmp_path, SHORT_CONFIG, resume=True, context=QUIET_CONTEXT)


CURVE_RECORD = {"step": 1, "loss": 0.1, "psnr": 20.5, "gaussians": 5}


@pytest.mark.parametrize(
    "damage",
    [
        {},
        {"settings": []},
        {"metrics": []},
        {"metrics": {"gaussians": 5, "curve": []}},
        {"metrics": {"gaussians": 5, "bytes": 5}},
        {"metrics": {"gaussians": "5", "bytes": 5, "curve": []}},
        {"metrics": {"gaussians": 5, "bytes": 5, "curve": [1]}},
        {"metrics": {"gaussians": 5, "bytes": 5, "curve": [{"step": 1}]}},
        {"metrics": {"gaussians": 5, "bytes": 5, "curve": [CURVE_RECORD | {"psnr": "20"}]}},
        {"metrics": {"gaussians": 5, "bytes": 5, "curve": [CURVE_RECORD | {"loss": float("nan")}]}},
        {"step": "20"},
        {"model": "folder/model.hyrf"},
    ],
    ids=str,
)
def test_a_training_record_with_invalid_values_is_ignored(tmp_path, damage):
    (tmp_path / "model.hyrf").write_bytes(b"model")
    facts = {"curve": [CURVE_RECORD], "gaussians": 5, "bytes": 5}
    record = TrainingRecord("model.hyrf", hashlib.sha256(b"model").hexdigest(), 20, {}, facts)
    (tmp_path / RECORD_FILE).write_bytes(dataclasses.replace(record, **damage).encode())
    assert read_record(tmp_path) == (None if damage else record)


def test_the_log_of_a_completed_run_ends_with_its_scores(full_disk_suffixes, tmp_path):
    full_disk_suffixes.add("metrics.json")
    train_model(make_scene(), tmp_path / "run", SHORT_CONFIG, context=QUIET_CONTEXT)
    full_disk_suffixes.clear()
    result = train_model(
        make_scene(), tmp_path / "run", SHORT_CONFIG, context=QUIET_CONTEXT, log=tmp_path / "log.jsonl"
    )
    (end,) = map(json.loads, (tmp_path / "log.jsonl").read_text().splitlines())
    assert end["event"] == "end" and end["complete"] is True and end["step"] == 8
    assert end["psnr"] == pytest.approx(result.metrics["evaluation"]["psnr"], rel=1e-5)


# -- progress --------------------------------------------------------------------------------------------------------


def test_phases_before_and_after_the_steps_report_their_progress(tmp_path):
    events: list[Event] = []
    train_model(make_scene(), tmp_path, SHORT_CONFIG, context=RunContext(progress=events.append))
    tasks = [event for event in events if isinstance(event, TaskEvent)]
    assert list(dict.fromkeys(event.task for event in tasks)) == [
        "reading held-out photos",
        "reading photos",
        "reading photos and setting up the model",
        "preparing the first step",
        "measuring the share of the background",
        "writing the model",
        "scoring held-out photos",
        "drawing curve.png",
    ]
    assert [event for event in tasks if event.task.startswith("scoring")] == [
        TaskEvent("scoring held-out photos", done=done, total=2) for done in range(3)
    ]
    assert all(0 <= event.done <= event.total for event in tasks)

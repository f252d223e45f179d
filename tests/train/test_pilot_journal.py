"""A resumed run does not repeat the pilot runs that its first part finished."""

from __future__ import annotations

import json
import signal
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pilot_runs import CPU_DEVICE, interrupt_at, make_scene
from property_tests import examples
from scenes import QUIET_CONTEXT

from hyrfpack.context import RunContext
from hyrfpack.data import PictureCache
from hyrfpack.errors import HyrfError
from hyrfpack.format.run_folder import CHECKPOINT_FILE, PILOT_CHECKPOINT_FILE, PILOTS_FILE
from hyrfpack.progress import Event, TaskEvent
from hyrfpack.train import TrainConfig, pilot_journal, train_model
from hyrfpack.train.pilot_journal import PilotJournal, PilotScore, read_scores
from hyrfpack.train.pilots import ScenePilots
from hyrfpack.train.run import is_begun
from hyrfpack.train.stop import TrainingStopped

TEN_STEP_CONFIG = TrainConfig(steps=10)
RESUMED_FILES = {PILOTS_FILE, PILOT_CHECKPOINT_FILE, CHECKPOINT_FILE}


def interrupt_pilot(number: int, step: int) -> RunContext:
    """Return a context that sends SIGTERM after a step of the budget pilot of this number."""

    def interrupt(event: Event) -> None:
        is_pilot = isinstance(event, TaskEvent) and event.task == f"budget pilot run {number}/2: training"
        if is_pilot and event.done == step:
            signal.raise_signal(signal.SIGTERM)

    return RunContext(progress=interrupt)


def follow_pilots(steps: list[tuple[str, int]]) -> RunContext:
    """Return a context that adds the name and step of each step of a pilot to a list."""

    def follow(event: Event) -> None:
        if isinstance(event, TaskEvent) and event.task.endswith(": training") and event.done is not None:
            steps.append((event.task.removesuffix(": training"), event.done))

    return RunContext(progress=follow)


def left_files(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()} & RESUMED_FILES


def assert_same_results(first: Path, second: Path) -> None:
    """Assert that two finished runs have the same model and the same pilots."""
    assert (first / "model.hyrf").read_bytes() == (second / "model.hyrf").read_bytes()
    one, other = (json.loads((folder / "metrics.json").read_bytes()) for folder in (first, second))
    assert one["pilots"] == other["pilots"] and one["choices"] == other["choices"]
    assert not left_files(first) and not left_files(second)


@pytest.mark.usefixtures("short_pilots", "signals")
@pytest.mark.parametrize("has_checkpoints", [False, True])
def test_a_resumed_run_goes_on_in_the_pilot_that_was_interrupted(tmp_path, monkeypatch, has_checkpoints):
    if has_checkpoints:
        monkeypatch.setattr(pilot_journal, "MIN_CHECKPOINT_STEPS", 6)
    train_model(make_scene(), tmp_path / "whole", TEN_STEP_CONFIG, context=QUIET_CONTEXT)
    again = tmp_path / "again"
    assert not train_model(make_scene(), again, TEN_STEP_CONFIG, context=interrupt_pilot(2, 3)).complete
    assert left_files(again) == ({PILOTS_FILE, PILOT_CHECKPOINT_FILE} if has_checkpoints else {PILOTS_FILE})
    assert is_begun(again)

    steps: list[tuple[str, int]] = []
    assert train_model(make_scene(), again, TEN_STEP_CONFIG, resume=True, context=follow_pilots(steps)).complete
    assert steps[0] == ("budget pilot run 2/2", 4 if has_checkpoints else 1)
    assert_same_results(tmp_path / "whole", again)
    assert not is_begun(again)


@pytest.mark.usefixtures("short_pilots", "signals")
def test_a_run_that_is_interrupted_after_its_pilots_resumes_from_its_checkpoint(tmp_path):
    train_model(make_scene(), tmp_path / "whole", TEN_STEP_CONFIG, context=QUIET_CONTEXT)
    assert train_model(make_scene(), tmp_path / "again", TEN_STEP_CONFIG, context=interrupt_at(6)).step == 6
    steps: list[tuple[str, int]] = []
    train_model(make_scene(), tmp_path / "again", TEN_STEP_CONFIG, resume=True, context=follow_pilots(steps))
    assert not steps
    assert_same_results(tmp_path / "whole", tmp_path / "again")


@pytest.mark.usefixtures("short_pilots", "signals")
def test_pilots_are_not_replaced_unless_asked(tmp_path):
    train_model(make_scene(), tmp_path, TEN_STEP_CONFIG, context=interrupt_pilot(2, 3))
    before = (tmp_path / PILOTS_FILE).read_bytes()
    with pytest.raises(HyrfError, match=r"holds an earlier run \(pilots\.json\)") as error:
        train_model(make_scene(), tmp_path, TEN_STEP_CONFIG, context=QUIET_CONTEXT)
    assert error.value.fix == "`resume=True` continues it, `overwrite=True` replaces it"
    assert (tmp_path / PILOTS_FILE).read_bytes() == before

    steps: list[tuple[str, int]] = []
    assert train_model(make_scene(), tmp_path, TEN_STEP_CONFIG, overwrite=True, context=follow_pilots(steps)).complete
    assert steps[0] == ("budget pilot run 1/2", 1) and not left_files(tmp_path)


@pytest.mark.usefixtures("short_pilots", "signals")
@pytest.mark.parametrize(
    ("name", "content"),
    [(PILOTS_FILE, b'{"version": 1, "scores": {'), (PILOT_CHECKPOINT_FILE, b"no checkpoint")],
)
def test_a_damaged_file_costs_a_repeated_pilot_but_changes_nothing(tmp_path, monkeypatch, name, content):
    monkeypatch.setattr(pilot_journal, "MIN_CHECKPOINT_STEPS", 6)
    train_model(make_scene(), tmp_path / "whole", TEN_STEP_CONFIG, context=QUIET_CONTEXT)
    train_model(make_scene(), tmp_path / "again", TEN_STEP_CONFIG, context=interrupt_pilot(2, 3))
    (tmp_path / "again" / name).write_bytes(content)
    train_model(make_scene(), tmp_path / "again", TEN_STEP_CONFIG, resume=True, context=QUIET_CONTEXT)
    assert_same_results(tmp_path / "whole", tmp_path / "again")


def interrupted_pilots(folder: Path) -> None:
    """Interrupt a pilot with seed 0 after its third step, so that it leaves a checkpoint."""
    count = [0]

    def stop() -> bool:
        return count[0] >= 3

    def follow(_: object) -> None:
        count[0] += 1

    runs = ScenePilots(
        make_scene(),
        TEN_STEP_CONFIG,
        PictureCache(),
        CPU_DEVICE,
        stop=stop,
        observer=follow,
        journal=PilotJournal(folder),
    )
    with pytest.raises(TrainingStopped):
        runs.run("pilot", runs.fold(), 6, seed=0, exposure=False)
    assert left_files(folder) == {PILOT_CHECKPOINT_FILE}


@pytest.mark.parametrize(("seed", "first"), [(0, 4), (1, 1)])
def test_a_checkpoint_is_used_only_for_the_pilot_it_belongs_to(tmp_path, monkeypatch, caplog, seed, first):
    monkeypatch.setattr(pilot_journal, "MIN_CHECKPOINT_STEPS", 6)
    interrupted_pilots(tmp_path)
    steps: list[int] = []
    runs = ScenePilots(
        make_scene(), TEN_STEP_CONFIG, PictureCache(), CPU_DEVICE, journal=PilotJournal(tmp_path),
        observer=lambda trainer: steps.append(trainer.step),
    )  # fmt: skip
    with caplog.at_level("INFO"):
        score = runs.run("pilot", runs.fold(), 6, seed=seed, exposure=False)
    assert steps == list(range(first, 7)) and runs.steps == 6
    assert any("this pilot run starts from its first step" in message for message in caplog.messages) == (first == 1)
    assert list(read_scores(tmp_path).values()) == [score] and left_files(tmp_path) == {PILOTS_FILE}


def test_a_known_pilot_is_not_run_and_its_steps_count(tmp_path):
    def run_pilot() -> tuple[PilotScore, ScenePilots]:
        journal = PilotJournal(tmp_path, read_scores(tmp_path))
        runs = ScenePilots(make_scene(), TEN_STEP_CONFIG, PictureCache(), CPU_DEVICE, journal=journal)
        return runs.run("pilot", runs.fold(reduction=2), 6, seed=0, exposure=False), runs

    score, first = run_pilot()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("hyrfpack.train.pilots.Trainer", lambda *_: pytest.fail("trained again"))
        again, second = run_pilot()
    assert again == score and second.scores == first.scores == [score] and second.steps == first.steps


def test_pilots_with_other_photos_settings_or_steps_of_the_run_are_other_pilots(tmp_path):
    def run_pilot(views: int, config: TrainConfig, **settings: object) -> None:
        journal = PilotJournal(tmp_path, read_scores(tmp_path))
        runs = ScenePilots(make_scene(views), config, PictureCache(), CPU_DEVICE, journal=journal)
        runs.run("pilot", runs.fold(), 2, **{"seed": 0, "exposure": False, **settings})

    run_pilot(10, TEN_STEP_CONFIG)
    run_pilot(10, TEN_STEP_CONFIG)
    run_pilot(11, TEN_STEP_CONFIG)
    run_pilot(10, TrainConfig(steps=11))
    run_pilot(10, TEN_STEP_CONFIG, seed=1)
    run_pilot(10, TEN_STEP_CONFIG, max_gaussians=50)
    assert len(read_scores(tmp_path)) == 5


def test_a_score_that_cannot_be_written_is_a_warning(tmp_path, caplog):
    (tmp_path / PILOTS_FILE).mkdir()
    score = PilotScore(6, 10, 0, 100, False, 20.0, 0.5, 20.0, [20.0])
    journal = PilotJournal(tmp_path)
    journal.add("key", score)
    assert journal.find("key") == score
    assert "would repeat this pilot run if it were interrupted" in caplog.text


VALID_SCORE = {
    "steps": 6, "run_steps": 10, "seed": 0, "max_gaussians": 100, "exposure": False, "psnr": 20.0, "ssim": 0.5,
    "psnr_corrected": 20.0, "psnr_per_view": [20.0],
}  # fmt: skip
JSON_VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=3),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=5,
)


@examples(60)
@given(field=st.sampled_from([*VALID_SCORE, "unknown"]), value=JSON_VALUES, whole=st.booleans())
def test_fields_of_other_types_make_the_file_count_as_damaged(tmp_path_factory, field, value, whole):
    folder = tmp_path_factory.mktemp("run")
    content = value if whole else {"version": 1, "scores": {"key": {**VALID_SCORE, field: value}}}
    (folder / PILOTS_FILE).write_text(json.dumps(content))
    for score in read_scores(folder).values():
        assert np.isfinite([score.psnr, score.ssim, *score.psnr_per_view]).all()
        assert type(score.steps) is int and type(score.exposure) is bool and isinstance(score.psnr_per_view, list)


def test_scores_are_read_as_written(tmp_path):
    (tmp_path / PILOTS_FILE).write_text(json.dumps({"version": 1, "scores": {"key": VALID_SCORE}}))
    assert read_scores(tmp_path) == {"key": PilotScore(**VALID_SCORE)}
    (tmp_path / PILOTS_FILE).write_text(json.dumps({"version": 2, "scores": {"key": VALID_SCORE}}))
    assert read_scores(tmp_path) == {}

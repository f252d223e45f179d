"""Pilot runs choose the Gaussian budget, and the main run keeps it."""

from __future__ import annotations

import dataclasses
import json

import pytest
from pilot_runs import (
    CPU_DEVICE,
    LONG_CONFIG,
    assert_resume_is_rejected,
    interrupt_at,
    make_evaluation,
    make_scene,
    mask_all_pixels,
)
from scenes import QUIET_CONTEXT

from hyrfpack.context import RunContext
from hyrfpack.data import PictureCache
from hyrfpack.progress import Event, StepEvent, TaskEvent
from hyrfpack.scene import Scene
from hyrfpack.train import TrainConfig, budget_pilots, decisions, pilots, train_model
from hyrfpack.train.budget_pilots import BUDGET_FACTORS, measure_budget
from hyrfpack.train.decisions import (
    MIN_BUDGET_STEPS,
    max_pilot_steps,
    measures_budget,
)
from hyrfpack.train.pilots import ScenePilots
from hyrfpack.train.stop import TrainingStopped


def measure_scene_budget(scene: Scene, config: TrainConfig = LONG_CONFIG, **options) -> tuple[float, str]:
    return measure_budget(ScenePilots(scene, config, PictureCache(), CPU_DEVICE, **options), exposure=False)


@pytest.mark.parametrize(
    ("gain", "factor"),
    [(-1.0, 0.25), (0.0, 0.25), (0.29, 0.25), (0.31, 0.35), (0.5, 0.5), (0.8, 0.7), (1.2, 1.0), (1.3, 1.5), (9.0, 1.5)],
)
def test_the_budget_factor_follows_the_gain_of_two_doublings(scores, gain, factor):
    gain *= budget_pilots.EXPECTED_GAIN_DB
    scores |= {1250: 20.0, 5000: 20.0 + gain}
    steps = budget_pilots.BUDGET_PILOT_STEPS
    why = f"in {steps} steps 5,000 Gaussians scored {gain:+.2f} dB and +0.000 of SSIM over 1,250"
    assert measure_scene_budget(make_scene()) == (factor, why)


def test_ssim_counts_in_the_budget(scores):
    half = budget_pilots.EXPECTED_GAIN_DB / 2
    scores |= {1250: (20.0, 0.5), 5000: (20.0 + half, 0.5 + half / pilots.SSIM_WEIGHT_DB)}
    factor, why = measure_scene_budget(make_scene())
    assert factor == 1.0 and f"{half:+.2f} dB and {half / pilots.SSIM_WEIGHT_DB:+.3f} of SSIM" in why


@pytest.mark.parametrize(("first", "second", "factor"), [(0.1, 0.9, 0.5), (0.9, 0.1, 0.5), (1.0, 0.0, 1.0)])
def test_a_smaller_budget_needs_two_seeds(monkeypatch, scores, first, second, factor):
    gains = {0: first * budget_pilots.EXPECTED_GAIN_DB, 1: second * budget_pilots.EXPECTED_GAIN_DB}
    seeds: list[int] = []

    class Seeded(pilots.Trainer):  # this is the Trainer that `scores` has put there
        def __init__(self, scene, config, cache, device):
            self.model = 20 + gains[config.seed] * (config.max_gaussians == 5000)
            seeds.append(config.seed)

    monkeypatch.setattr(pilots, "Trainer", Seeded)
    monkeypatch.setattr(pilots, "evaluate_model", lambda model, views, progress: make_evaluation(0.0, model))
    assert measure_scene_budget(make_scene())[0] == factor
    assert seeds == ([0, 0] if first >= 1 else [0, 0, 1, 1])


@pytest.mark.parametrize(
    ("change", "views", "expected"),
    [
        ({}, 8, True),
        ({}, 7, False),
        ({"steps": MIN_BUDGET_STEPS - 1}, 8, False),
        ({"max_gaussians": 500}, 8, False),
        ({"target_bytes": 50_000}, 8, False),
        ({"budget_factor": 1.0}, 8, False),
    ],
)
def test_the_budget_is_measured_only_where_it_is_unset_and_steps_and_photos_suffice(change, views, expected):
    assert measures_budget(make_scene(views), dataclasses.replace(LONG_CONFIG, **change)) is expected


@pytest.mark.parametrize("surface_points", [True, False])
def test_pilots_start_as_the_run_does_by_default(monkeypatch, scores, surface_points):
    settings: list[TrainConfig] = []

    class Recorded(pilots.Trainer):  # this is the Trainer that `scores` has put there
        def __init__(self, scene, config, cache, device):
            super().__init__(scene, config, cache, device)
            settings.append(config)

    monkeypatch.setattr(pilots, "Trainer", Recorded)
    scores[70] = 20.0
    runs = ScenePilots(make_scene(), TrainConfig(surface_points=surface_points), PictureCache(), CPU_DEVICE)
    runs.run("default", runs.fold(), 70, seed=0, exposure=False)
    runs.run("points alone", runs.fold(), 70, seed=1, exposure=False, surface_points=False)
    assert [config.surface_points for config in settings] == [surface_points, False]


@pytest.mark.usefixtures("short_pilots")
def test_pilots_are_deterministic_and_report_each_step():
    events: list[TaskEvent] = []
    first = measure_scene_budget(make_scene(), progress=events.append, max_steps=24)
    assert first == measure_scene_budget(make_scene())
    assert first is not None and first[0] in BUDGET_FACTORS
    shares = [event.share for event in events if event.share is not None]
    assert shares in ([step / 24 for step in range(1, 13)], [step / 24 for step in range(1, 25)])


@pytest.mark.usefixtures("short_pilots")
def test_pilots_stop_when_requested():
    steps: list[TaskEvent] = []

    def follow(event: TaskEvent) -> None:
        steps.extend([event] * event.task.endswith("training"))

    with pytest.raises(TrainingStopped):
        measure_scene_budget(make_scene(), progress=follow, stop=lambda: len(steps) >= 8)
    assert len(steps) == 8


@pytest.mark.usefixtures("short_pilots")
@pytest.mark.parametrize("left", [0, 1])
def test_completely_masked_photos_are_no_validation_photos(left, monkeypatch):
    judged: list[list[str]] = []
    monkeypatch.setattr(
        pilots,
        "evaluate_model",
        lambda _, views, progress: judged.append([view.name for view in views]) or make_evaluation(0.0, 20.0),
    )
    scene = make_scene()
    judges = [view.name for view in pilots.split(scene.train)[1]]
    views = [mask_all_pixels(view) if view.name in judges[left:] else view for view in scene.train]
    factor, why = measure_scene_budget(dataclasses.replace(scene, train=views))
    if left:
        assert judged == [judges[:1]] * 4  # without a gain each size is scored twice
    else:
        assert (factor, why) == (1.0, "masks leave no pixel of the validation photos") and not judged


@pytest.mark.usefixtures("short_pilots")
def test_a_run_takes_the_budget_of_its_pilots_and_records_the_reason(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(decisions, "measure_budget", lambda *_: (0.5, "by a coin"))
    train_model(make_scene(), tmp_path, TrainConfig(steps=10))
    metrics = json.loads((tmp_path / "metrics.json").read_bytes())
    assert metrics["settings"]["budget_factor"] == 0.5
    reason = metrics["choices"]["max_gaussians"]
    assert reason.startswith("2,500: 0.5 times what suits ") and reason.endswith(" steps; by a coin")
    assert f"Gaussian budget: {reason}" in caplog.messages


@pytest.mark.acceptance
@pytest.mark.usefixtures("short_pilots", "signals")
def test_a_run_that_continues_keeps_its_budget_and_the_reason(tmp_path, monkeypatch):
    config = TrainConfig(steps=10)
    train_model(make_scene(), tmp_path / "whole", config, context=QUIET_CONTEXT)
    assert train_model(make_scene(), tmp_path / "again", config, context=interrupt_at(6)).step == 6

    monkeypatch.setattr(decisions, "measure_budget", lambda *_: pytest.fail("measured again"))
    for asked in ({"max_gaussians": 5_000}, {"target_bytes": 20_000}, {"budget_factor": 0.9}):
        assert_resume_is_rejected(tmp_path / "again", dataclasses.replace(config, **asked))
    train_model(make_scene(), tmp_path / "again", config, resume=True, context=QUIET_CONTEXT)

    whole, again = (json.loads((tmp_path / name / "metrics.json").read_bytes()) for name in ("whole", "again"))
    assert whole["settings"] == again["settings"] and whole["choices"] == again["choices"]
    assert "scored" in whole["choices"]["max_gaussians"]
    assert (tmp_path / "whole/model.hyrf").read_bytes() == (tmp_path / "again/model.hyrf").read_bytes()


@pytest.mark.usefixtures("short_pilots", "signals")
def test_an_interrupt_before_the_first_step_leaves_nothing(tmp_path):
    result = train_model(make_scene(), tmp_path, TrainConfig(steps=10), context=interrupt_at(0))
    assert (result.complete, result.step, result.model, result.metrics) == (False, 0, None, {})
    assert not any(tmp_path.iterdir())


@pytest.mark.usefixtures("short_pilots")
def test_pilots_are_reported_as_tasks_before_the_steps(tmp_path):
    events: list[Event] = []
    train_model(make_scene(), tmp_path, TrainConfig(steps=10), context=RunContext(progress=events.append))
    steps = [event for event in events if isinstance(event, StepEvent)]
    assert [(event.step, event.steps) for event in steps] == [(step, 10) for step in range(1, 11)]
    pilots = [event for event in events if isinstance(event, TaskEvent) and event.share is not None]
    most = max_pilot_steps(make_scene(), TrainConfig(steps=10))
    assert [event.share for event in pilots] == [n / most for n in range(1, len(pilots) + 1)]
    assert len(pilots) in (12, 24) and events.index(pilots[-1]) < events.index(steps[0])


@pytest.mark.usefixtures("short_pilots")
def test_pilot_runs_report_each_step_and_each_scored_view():
    events: list[TaskEvent] = []
    measure_scene_budget(make_scene(), progress=events.append)
    for task, counts in (("1/2: training", range(1, 7)), ("2/2: scoring", range(3))):
        task = f"budget pilot run {task}"
        assert [event for event in events if event.task == task] == [
            TaskEvent(task, done=done, total=max(counts)) for done in counts
        ]

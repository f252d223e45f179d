"""Decisions of pilot runs about a scene, and how the main run keeps them."""

from __future__ import annotations

import dataclasses
import json
import signal
from pathlib import Path

import numpy as np
import pytest
import torch
from scenes import QUIET_CONTEXT, ball_scene

from hyrfpack.context import RunContext
from hyrfpack.data import PictureCache
from hyrfpack.errors import HyrfTrainingError
from hyrfpack.evaluate import Evaluation
from hyrfpack.evaluate.view_scores import ViewScore
from hyrfpack.format.exposure_header import STOPS_PER_LOG_GAIN
from hyrfpack.model.exposure import apply_exposure_gains
from hyrfpack.progress import Event, StepEvent, TaskEvent
from hyrfpack.scene import Scene, View
from hyrfpack.train import TrainConfig, budget_pilots, decisions, exposure_pilots, length_pilots, pilots, train_model
from hyrfpack.train.budget_pilots import BUDGET_FACTORS, measure_budget
from hyrfpack.train.checkpoint import read_asked_steps
from hyrfpack.train.decisions import (
    MIN_BUDGET_STEPS,
    MIN_EXPOSURE_STEPS,
    Decisions,
    decide,
    max_pilot_steps,
    measures_budget,
    measures_exposure,
    measures_length,
)
from hyrfpack.train.exposure_pilots import measure_exposure
from hyrfpack.train.length_pilots import measure_length
from hyrfpack.train.pilots import PilotsStopped, ScenePilots
from hyrfpack.train.setup import budget_for

CPU_DEVICE = torch.device("cpu")
LONG_CONFIG = TrainConfig(steps=MIN_BUDGET_STEPS)


def make_scene(views: int = 10) -> Scene:
    return ball_scene(views=views, points=60, side=24)


def measure_scene_budget(scene: Scene, config: TrainConfig = LONG_CONFIG, **options) -> tuple[float, str]:
    return measure_budget(ScenePilots(scene, config, PictureCache(), CPU_DEVICE, **options), exposure=False)


@pytest.fixture
def short_pilots(monkeypatch) -> None:
    """Pilots also precede runs of ten steps, and are short."""
    monkeypatch.setattr(decisions, "MIN_BUDGET_STEPS", 10)
    monkeypatch.setattr(budget_pilots, "BUDGET_PILOT_STEPS", 6)


def make_evaluation(
    psnr: float, corrected: float = 0.0, apart: tuple[float, ...] = (0.0, 0.0), ssim: float = 0.5
) -> Evaluation:
    views = [ViewScore("view", psnr + part, None, corrected, ssim, None) for part in apart]
    return Evaluation(psnr, None, corrected, ssim, None, "", 0, 0.0, views)


def with_ssim(score: float | tuple[float, float]) -> tuple[float, float]:
    """Return a PSNR and an SSIM from a pair of both, or from a PSNR alone."""
    return score if isinstance(score, tuple) else (score, 0.5)


@pytest.fixture
def scores(monkeypatch) -> dict:
    """Scores of models by their steps, by their budget, or by whether they learn gains. No model is trained.

    By steps or budget, a score is a PSNR or a pair of PSNR and SSIM.
    """
    table: dict = {}

    class Untrained:
        def __init__(self, scene, config, cache, device):
            self.model = config

        def run(self, progress, stop):
            pass

    def evaluate(config, views, progress):
        if config.steps in table:
            psnr, ssim = with_ssim(table[config.steps])
            return make_evaluation(psnr, ssim=ssim)
        if config.exposure in table:
            return make_evaluation(
                table[config.exposure][config.seed],
                0.0,
                table["apart"] if config.exposure else (0.0,) * len(table["apart"]),
            )
        corrected, ssim = with_ssim(table[config.max_gaussians])
        return make_evaluation(0.0, corrected, ssim=ssim)

    monkeypatch.setattr(pilots, "Trainer", Untrained)
    monkeypatch.setattr(pilots, "evaluate_model", evaluate)
    return table


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
    runs.run("points alone", runs.fold(), 70, seed=0, exposure=False, surface_points=False)
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

    with pytest.raises(PilotsStopped):
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


def mask_all_pixels(view: View) -> View:
    picture = view.load()
    nothing = dataclasses.replace(picture, mask=np.zeros(picture.rgb.shape[:2], bool))
    return dataclasses.replace(view, load=lambda: nothing)


@pytest.mark.usefixtures("short_pilots")
def test_a_run_takes_the_budget_of_its_pilots_and_records_the_reason(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(decisions, "measure_budget", lambda *_: (0.5, "by a coin"))
    train_model(make_scene(), tmp_path, TrainConfig(steps=10))
    metrics = json.loads((tmp_path / "metrics.json").read_bytes())
    assert metrics["settings"]["budget_factor"] == 0.5
    reason = metrics["choices"]["max_gaussians"]
    assert reason.startswith("2,500: 0.5 times what suits ") and reason.endswith(" steps; by a coin")
    assert f"Gaussian budget: {reason}" in caplog.messages


def interrupt_at(step: int) -> RunContext:
    """Return a context that sends SIGTERM once, as a user would, after a step; 0 means the first step of a pilot."""
    left = [step]

    def interrupt(event: Event) -> None:
        is_pilot = isinstance(event, TaskEvent) and event.task.endswith(": training")
        if left and (is_pilot if step == 0 else isinstance(event, StepEvent) and event.step == step):
            left.clear()
            signal.raise_signal(signal.SIGTERM)

    return RunContext(progress=interrupt)


def assert_resume_is_rejected(folder: Path, config: TrainConfig) -> None:
    """Assert that the run in a folder cannot be resumed with these settings."""
    with pytest.raises(HyrfTrainingError, match="started with other settings"):
        train_model(make_scene(), folder, config, resume=True, context=QUIET_CONTEXT)


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


# -- exposure --------------------------------------------------------------------------------------------------------


def expose_scene(scene: Scene, stops: list[float]) -> Scene:
    """Return the scene with its training photos exposed by these stops, in order."""

    def exposed(view: View, gain: float) -> View:
        picture = view.load()
        rgb = apply_exposure_gains(torch.from_numpy(picture.rgb).double() / 255, torch.full((3,), gain).double())
        lit = dataclasses.replace(picture, rgb=(rgb * 255).round().byte().numpy())
        return dataclasses.replace(view, load=lambda: lit)

    gains = np.exp(np.resize(stops, len(scene.train)) / STOPS_PER_LOG_GAIN)
    return dataclasses.replace(scene, train=[exposed(*pair) for pair in zip(scene.train, gains, strict=True)])


@pytest.mark.parametrize(
    ("compensated", "apart", "expected", "rounds"),
    [
        ([20.3, 20.2], (0.0,) * 5, True, 2),
        ([20.3, 20.2], (-0.2, 0.2, 0.0, -0.2, 0.2), True, 2),
        ([20.4, 19.0], (-0.3, 0.3, 0.0, 0.0, -0.3, 0.3), True, 1),
        ([20.2, 20.2], (-0.6, 0.6, 0.0, 0.0, -0.6, 0.6), True, 2),
        ([20.3, 20.2], (-2.0, 2.0, 0.0, -2.0, 2.0), False, 2),
        ([20.5, 20.5], (-9.0, 0.0, 0.0, 0.0, 0.0), False, 1),
        ([22.5, 22.5], (-9.0, 0.0, 0.0, 0.0, 0.0), True, 2),
        ([20.25, 19.9], (0.0,) * 5, False, 2),
        ([20.05, 20.05], (0.0,) * 5, False, 2),
        ([19.9, 25.0], (0.0,) * 5, False, 1),
        ([20.0, 25.0], (0.0,) * 5, False, 1),
    ],
)
def test_gains_are_learnt_only_where_the_improvement_is_significant(
    scores, monkeypatch, compensated, apart, expected, rounds
):
    assert decide_exposure(scores, monkeypatch, 0.15, compensated, apart) == (expected, rounds)


@pytest.mark.parametrize(
    ("compensated", "apart", "expected", "rounds"),
    [
        ([20.05, 20.05], (0.0,) * 5, True, 2),
        ([20.05, 20.05], (0.0,) * 6, True, 1),
        ([19.95, 19.95], (-0.2, 0.2, 0.0, -0.2, 0.2), True, 2),
        ([19.0, 20.9], (-2.0, 2.0, 0.0, -2.0, 2.0), True, 2),
        ([19.0, 20.7], (-2.0, 2.0, 0.0, -2.0, 2.0), False, 2),
        ([19.0, 25.0], (0.0,) * 6, False, 1),
    ],
)
def test_gains_are_learnt_unless_they_lose_where_exposures_differ_much(
    scores, monkeypatch, compensated, apart, expected, rounds
):
    assert decide_exposure(scores, monkeypatch, 0.3, compensated, apart) == (expected, rounds)


def decide_exposure(
    scores: dict, monkeypatch, spread: float, compensated: list[float], apart: tuple[float, ...]
) -> tuple[bool, int]:
    """Return the decision and the number of rounds for photos of such a spread in stops and pilots of such scores."""
    monkeypatch.setattr(exposure_pilots, "estimate_exposure_spread", lambda *_: spread)
    scores |= {False: [20.0, 20.0], True: compensated, "apart": apart}
    runs = ScenePilots(make_scene(20), LONG_CONFIG, PictureCache(), CPU_DEVICE)
    decision, reason = measure_exposure(runs)

    assert "validation photos" in reason
    pilots_run = [(score.seed, score.exposure) for score in runs.scores]
    assert pilots_run == [(0, False), (0, True), (1, False), (1, True)][: len(pilots_run)]
    return decision, len(pilots_run) // 2


@pytest.mark.parametrize(("steps", "pilot_steps"), [(1_000, 167), (900, 150), (3_000, 500), (30_000, 500)])
def test_pilots_have_a_sixth_of_the_steps_of_the_run_within_limits(steps, pilot_steps):
    assert exposure_pilots.exposure_pilot_steps(steps) == pilot_steps


@pytest.mark.parametrize("left", [0, 1, 3, 5])
def test_too_few_unmasked_validation_photos_decide_nothing(scores, monkeypatch, left):
    monkeypatch.setattr(exposure_pilots, "estimate_exposure_spread", lambda *_: 1.0)
    scores |= {False: [20.0] * 2, True: [25.0] * 2, "apart": (0.0,) * left}
    scene = make_scene(20)
    usable = {view.name for view in pilots.split(scene.train, 4, 16)[1][:left]}
    views = [view if view.name in usable else mask_all_pixels(view) for view in scene.train]
    decision, reason = measure_exposure(
        ScenePilots(dataclasses.replace(scene, train=views), LONG_CONFIG, PictureCache(), CPU_DEVICE)
    )
    assert decision is False and reason.startswith(f"masks leave {left} of the validation photos, too few")


def test_a_loss_that_ends_the_rounds_early_is_the_reason_also_of_few_validation_photos(scores, monkeypatch):
    monkeypatch.setattr(exposure_pilots, "estimate_exposure_spread", lambda *_: 0.1)
    scores |= {False: [20.0] * 2, True: [19.9] * 2, "apart": (0.0,) * 2}
    runs = ScenePilots(make_scene(8), LONG_CONFIG, PictureCache(), CPU_DEVICE)
    decision, reason = measure_exposure(runs)
    assert decision is False and len(runs.scores) == 2
    assert "scored -0.10 dB of plain PSNR" in reason and "on 2 validation photos" in reason


@pytest.mark.parametrize(("side", "trained_side"), [(127, 127), (128, 64), (131, 65)])
def test_exposure_pilots_train_on_photos_of_half_the_size_and_a_quarter_of_the_gaussians(
    scores, monkeypatch, side, trained_side
):
    monkeypatch.setattr(exposure_pilots, "estimate_exposure_spread", lambda *_: 0.3)
    scores |= {False: [20.0] * 2, True: [20.3] * 2, "apart": (0.0,) * 6}
    folds: list[pilots.Fold] = []
    fold = ScenePilots.fold
    monkeypatch.setattr(ScenePilots, "fold", lambda *arguments: folds.append(fold(*arguments)) or folds[-1])
    scene = ball_scene(views=24, points=60, side=side)
    runs = ScenePilots(scene, LONG_CONFIG, PictureCache(), CPU_DEVICE)

    measure_exposure(runs)

    sizes = {(view.camera.width, view.camera.height) for view in (*folds[0].scene.train, *folds[0].validation)}
    assert sizes == {(trained_side, trained_side)}
    assert {view.load().rgb.shape for view in folds[0].validation} == {(trained_side, trained_side, 3)}
    reduction = side // trained_side
    assert reduction**2 * folds[0].max_gaussians == pytest.approx(fold(runs, 4, 16).max_gaussians, abs=4)


def test_photos_of_one_exposure_need_no_pilots(monkeypatch):
    monkeypatch.setattr(exposure_pilots, "estimate_exposure_spread", lambda *_: 0.04)
    runs = ScenePilots(make_scene(20), LONG_CONFIG, PictureCache(), CPU_DEVICE)
    decision, reason = measure_exposure(runs)
    assert (decision, runs.scores) == (False, []) and reason == "by their tracks the photos differ by 0.04 stops"


def test_photos_without_tracks_need_no_pilots_and_are_not_said_to_have_one_exposure():
    runs = ScenePilots(make_scene(20), LONG_CONFIG, PictureCache(), CPU_DEVICE)
    decision, reason = measure_exposure(runs)
    assert (decision, runs.scores) == (False, []) and reason == "too few tracks show the photos' exposures"


@pytest.mark.parametrize(("photos", "rounds"), [(8, 3), (11, 3), (12, 2), (100, 2)])
def test_few_photos_take_more_folds_so_that_six_photos_validate(scores, monkeypatch, photos, rounds):
    monkeypatch.setattr(exposure_pilots, "estimate_exposure_spread", lambda *_: 0.15)
    scores |= {False: [20.0] * 4, True: [20.3] * 4, "apart": (-0.9, 0.9, 0.0, 0.0, 0.0)}
    validated: list[list[str]] = []
    fold = ScenePilots.fold

    def recorded(*arguments):
        result = fold(*arguments)
        validated.append([view.name for view in result.validation])
        return result

    monkeypatch.setattr(ScenePilots, "fold", recorded)
    decision, _ = measure_exposure(ScenePilots(make_scene(photos), LONG_CONFIG, PictureCache(), CPU_DEVICE))

    names = [name for views in validated for name in views]
    assert decision and len(validated) == rounds
    assert len(set(names)) == len(names) >= 6


@pytest.mark.parametrize(
    ("change", "views", "expected"),
    [
        ({}, 8, True),
        ({}, 7, False),
        ({"steps": MIN_EXPOSURE_STEPS}, 8, True),
        ({"steps": MIN_EXPOSURE_STEPS - 1}, 8, False),
        ({"exposure": False}, 8, False),
        ({"exposure": True}, 8, False),
    ],
)
def test_exposure_pilots_run_only_where_no_setting_decides_and_steps_and_photos_suffice(change, views, expected):
    config = dataclasses.replace(TrainConfig(steps=3_000), **change)
    assert measures_exposure(make_scene(views), config) is expected


def test_photos_with_transparency_get_no_gains():
    assert not measures_exposure(ball_scene(views=10, points=60, side=24, alpha=True), LONG_CONFIG)


def test_settings_that_are_given_need_no_pilots():
    config = TrainConfig(steps=MIN_BUDGET_STEPS, exposure=True, max_gaussians=100)
    assert decide(make_scene(), config, PictureCache(), CPU_DEVICE) == Decisions(config, {}, [])
    assert max_pilot_steps(make_scene(), config) == 0


def test_a_short_run_without_a_decision_learns_no_gains():
    decided = decide(make_scene(), TrainConfig(steps=10), PictureCache(), CPU_DEVICE)
    assert decided is not None and decided.config.exposure is False and decided.config.budget_factor is None


@pytest.mark.acceptance
@pytest.mark.usefixtures("short_pilots", "signals")
def test_a_run_that_continues_keeps_its_exposure_compensation(tmp_path, monkeypatch):
    monkeypatch.setattr(decisions, "MIN_EXPOSURE_STEPS", 10)
    monkeypatch.setattr(decisions, "measure_exposure", lambda *_: (True, "by a coin"))
    scene, config = expose_scene(make_scene(), [0.5, -0.5]), TrainConfig(steps=10)
    train_model(scene, tmp_path / "whole", config, context=QUIET_CONTEXT)
    assert train_model(scene, tmp_path / "again", config, context=interrupt_at(6)).step == 6
    monkeypatch.setattr(decisions, "measure_exposure", lambda *_: pytest.fail("measured again"))
    train_model(scene, tmp_path / "again", config, resume=True, context=QUIET_CONTEXT)

    whole, again = (json.loads((tmp_path / name / "metrics.json").read_bytes()) for name in ("whole", "again"))
    assert whole["settings"]["exposure"] is again["settings"]["exposure"] is True
    assert whole["choices"] == again["choices"] and whole["pilots"] == again["pilots"]
    assert "by a coin" in whole["choices"]["exposure"] and "centers" in whole["choices"]["exposure_map"]
    assert (tmp_path / "whole/model.hyrf").read_bytes() == (tmp_path / "again/model.hyrf").read_bytes()


# -- number of steps -------------------------------------------------------------------------------------------------


def measure_scene_length(steps: int) -> tuple[int, str, ScenePilots]:
    """Choose the number of steps of a run of at most `steps`; also return its pilots."""
    runs = ScenePilots(make_scene(), TrainConfig(steps=steps), PictureCache(), CPU_DEVICE)
    return *measure_length(runs, exposure=True, budget_factor=0.5), runs


@pytest.mark.parametrize(
    ("by_steps", "steps", "chosen", "measured"),
    [
        ({1000: 20.0, 3000: 19.8}, 7_000, 1_000, [1_000, 3_000]),
        ({1000: 20.0, 3000: 20.0}, 7_000, 1_000, [1_000, 3_000]),
        ({1000: 20.0, 3000: 20.1, 7000: 20.0}, 7_000, 3_000, [1_000, 3_000, 7_000]),
        ({1000: 20.0, 3000: 20.1, 7000: 20.2}, 7_000, 7_000, [1_000, 3_000, 7_000]),
        ({1000: 20.0, 3000: 20.1, 10000: 20.2, 30000: 19.0}, 30_000, 10_000, [1_000, 3_000, 10_000, 30_000]),
    ],
)
def test_a_longer_run_is_chosen_only_while_validation_photos_score_higher(scores, by_steps, steps, chosen, measured):
    scores |= by_steps
    choice, reason, runs = measure_scene_length(steps)
    assert choice == chosen
    assert [score.steps for score in runs.scores] == measured and all(score.exposure for score in runs.scores)
    assert all(f"{length:,} steps {by_steps[length]:.2f} dB, 0.500" in reason for length in measured)


@pytest.mark.parametrize(("psnr", "ssim", "chosen"), [(19.9, 0.803, 7_000), (19.9, 0.802, 1_000), (20.1, 0.797, 1_000)])
def test_ssim_counts_in_the_choice_of_the_length(scores, psnr, ssim, chosen):
    scores |= {1000: (20.0, 0.8), 3000: (psnr, ssim), 7000: (25.0, 0.8)}
    choice, reason, _ = measure_scene_length(7_000)
    assert choice == chosen and f"3,000 steps {psnr:.2f} dB, {ssim:.3f}" in reason


def test_each_length_pilot_has_the_budget_of_a_run_of_its_length(scores):
    scores |= {1000: 20.0, 3000: 20.1, 7000: 20.2}
    _, _, runs = measure_scene_length(7_000)
    training = runs.fold(4).scene
    assert [score.max_gaussians for score in runs.scores] == [
        budget_for(training, TrainConfig(steps=steps, budget_factor=0.5))[0] for steps in (1_000, 3_000, 7_000)
    ]


def test_photos_without_validation_photos_get_the_whole_run():
    scene = make_scene()
    masked = dataclasses.replace(scene, train=[mask_all_pixels(view) for view in scene.train])
    runs = ScenePilots(masked, TrainConfig(steps=7_000), PictureCache(), CPU_DEVICE)
    assert measure_length(runs, exposure=False, budget_factor=None) == (
        7_000,
        "masks leave no pixel of the validation photos",
    )
    assert not runs.scores


@pytest.mark.parametrize(
    ("steps", "photos", "lengths"),
    [
        (3_001, 8, [1_000, 3_001]),
        (6_000, 30, [1_000, 3_000, 6_000]),
        (20_000, 31, [3_000, 10_000, 20_000]),
        (30_000, 30, [1_000, 3_000, 10_000, 30_000]),
    ],
)
def test_pilots_are_at_most_half_as_long_as_the_run(steps, photos, lengths):
    assert length_pilots.pilot_lengths(steps, photos) == lengths


@pytest.mark.parametrize(
    ("change", "views", "expected"),
    [
        ({}, 8, True),
        ({}, 30, True),
        ({}, 7, False),
        ({}, 31, False),
        ({"steps": 3_000}, 8, False),
        ({"steps": 19_999}, 31, False),
        ({"steps": 20_000}, 31, True),
        ({"steps": 20_000}, 100, True),
        ({"steps": 20_000}, 101, False),
        ({"early_stop": False}, 8, False),
        ({"steps": 20_000, "early_stop": False}, 31, False),
    ],
)
def test_only_long_runs_on_few_photos_may_be_shortened(change, views, expected):
    config = dataclasses.replace(TrainConfig(steps=7_000), **change)
    assert measures_length(make_scene(views), config) is expected


@pytest.mark.usefixtures("signals")
def test_a_shortened_run_resumes_to_the_same_bytes_and_names_the_reason(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(length_pilots, "MAX_UNMEASURED_STEPS", 10)
    monkeypatch.setattr(length_pilots, "PILOT_LENGTHS_STEPS", (8,))
    monkeypatch.setattr(decisions, "measure_length", lambda *_: (8, "8: by a coin"))
    config = TrainConfig(steps=20)
    whole = train_model(make_scene(), tmp_path / "whole", config)
    assert whole.step == 8 and "Number of steps: 8: by a coin" in caplog.messages
    assert train_model(make_scene(), tmp_path / "again", config, context=interrupt_at(6)).step == 6

    monkeypatch.setattr(decisions, "measure_length", lambda *_: pytest.fail("measured again"))
    for asked in ({"early_stop": False}, {"steps": 30, "early_stop": False}):
        assert_resume_is_rejected(tmp_path / "again", dataclasses.replace(config, **asked))
    again = train_model(make_scene(), tmp_path / "again", config, resume=True, context=QUIET_CONTEXT)

    assert (
        again.metrics["settings"] == whole.metrics["settings"] and again.metrics["choices"]["steps"] == "8: by a coin"
    )
    assert (tmp_path / "whole/model.hyrf").read_bytes() == (tmp_path / "again/model.hyrf").read_bytes()


@pytest.mark.usefixtures("signals")
def test_an_interrupted_run_without_length_pilots_is_not_resumed_with_more_steps(tmp_path, monkeypatch):
    config = TrainConfig(steps=8)
    assert train_model(make_scene(), tmp_path, config, context=interrupt_at(4)).step == 4

    monkeypatch.setattr(length_pilots, "MAX_UNMEASURED_STEPS", 10)
    monkeypatch.setattr(length_pilots, "PILOT_LENGTHS_STEPS", (8,))
    assert_resume_is_rejected(tmp_path, dataclasses.replace(config, steps=20))
    assert train_model(make_scene(), tmp_path, config, resume=True, context=QUIET_CONTEXT).step == 8


@pytest.mark.parametrize(("asked", "steps"), [(7_000, 1_000), (None, 1_000), (6_000, 7_000), (1_000, 7_000)])
def test_a_shorter_length_counts_as_chosen_only_for_the_steps_that_were_asked_for(asked, steps):
    assert decisions.chosen_steps(make_scene(), TrainConfig(steps=7_000), 1_000, asked) == steps


def test_scores_of_length_pilots_state_the_steps_that_were_asked_for(scores):
    scores |= {1000: 20.0, 3000: 19.8}
    chosen, reason, runs = measure_scene_length(7_000)
    run = {"choices": {"steps": reason}, "pilots": [dataclasses.asdict(score) for score in runs.scores]}
    assert (chosen, read_asked_steps(run, chosen)) == (1_000, 7_000)

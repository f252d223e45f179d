"""The number of steps that fits a time limit follows from the measured cost."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from time import monotonic

import numpy as np
import pytest
import torch

from hyrfpack.config.make import MakeConfig
from hyrfpack.config.train import FULL_STEPS
from hyrfpack.context import RunContext
from hyrfpack.data import PictureCache, load_scene
from hyrfpack.make import make_scene, minutes
from hyrfpack.make.minutes import SceneCost, fit_plan_to_minutes
from hyrfpack.make.plan import Plan, estimate_depth_map_seconds
from hyrfpack.make.progress import Reporter
from hyrfpack.make.source import LoadSettings
from hyrfpack.progress import StageEvent, ignore_progress
from hyrfpack.scene import Scene
from hyrfpack.train import decisions
from hyrfpack.train.resolution import PhotoSize
from hyrfpack.train.setup import usual_steps


def make_plan(target_bytes: int | None = None, max_gaussians: int | None = None) -> Plan:
    return Plan(3_000, 1_600, target_bytes=target_bytes, max_gaussians=max_gaussians)


MEASURED_COST = SceneCost(
    step_seconds=0.1, step_seconds_per_gaussian=1e-6, decoding_seconds=0.01, cpu_pass_seconds=0.05, gaussians=5_000
)
CPU_DEVICE = torch.device("cpu")


@pytest.fixture(scope="module")
def scene(posed):
    return load_scene(posed)


@pytest.mark.parametrize("seconds", [60.0, 300.0, 1500.0])
def test_the_largest_number_of_steps_that_fits_is_used(seconds, scene):
    steps = MEASURED_COST.max_steps_within(scene, seconds)
    assert 1 < steps < FULL_STEPS
    assert MEASURED_COST.total_seconds(scene, steps) <= seconds < MEASURED_COST.total_seconds(scene, steps + 1)


def test_steps_are_limited_to_a_full_run(scene):
    assert MEASURED_COST.max_steps_within(scene, 1e9) == FULL_STEPS
    assert MEASURED_COST.max_steps_within(scene, 0.0) == 1


def test_step_time_grows_with_the_number_of_pixels(scene):
    four = MEASURED_COST.scaled_by_pixels(4.0)
    other_seconds = MEASURED_COST.decoding_seconds * len(scene.train) + estimate_depth_map_seconds(len(scene.train))
    assert four.training_seconds(scene, 1000) - MEASURED_COST.training_seconds(scene, 1000) == pytest.approx(
        3 * (MEASURED_COST.training_seconds(scene, 1000) - other_seconds)
    )


def test_a_smaller_model_takes_less_time(scene):
    small = replace(MEASURED_COST, requested=make_plan(15_000))
    assert small.training_seconds(scene, 1000) < MEASURED_COST.training_seconds(scene, 1000)
    assert (
        small.seconds_after_training(scene, 1000)["compression"]
        < MEASURED_COST.seconds_after_training(scene, 1000)["compression"]
    )


def test_teacher_runs_on_few_photos_are_part_of_the_time(scene):
    steps = usual_steps(PhotoSize.of_views(scene.train).pixels)
    longer = MEASURED_COST.total_seconds(scene, steps) - MEASURED_COST.total_seconds(scene, steps - 1)
    assert longer > MEASURED_COST.teacher_seconds(scene, steps) > 2 * MEASURED_COST.training_seconds(scene, 1_000)
    assert MEASURED_COST.teacher_seconds(scene, steps - 1) == 0


def test_time_that_is_too_short_for_teacher_runs_is_used_for_more_steps(scene):
    usual = usual_steps(PhotoSize.of_views(scene.train).pixels)
    alone, taught = (MEASURED_COST.total_seconds(scene, steps) for steps in (usual - 1, usual))
    short, between, long = (
        MEASURED_COST.plan_within(scene, seconds) for seconds in (alone - 1, (alone + taught) / 2, taught + 1)
    )
    assert short.steps < usual and (short.virtual_views, between.virtual_views, long.virtual_views) == (
        True,
        False,
        True,
    )
    assert long.steps >= usual
    without = replace(MEASURED_COST, requested=between)
    assert without.total_seconds(scene, between.steps) <= (alone + taught) / 2
    assert (alone + taught) / 2 < without.total_seconds(scene, between.steps + 1)


def test_a_linear_fit_is_exact_on_a_line_and_never_decreases():
    counts = list(range(100, 1000, 20))
    assert minutes._fit_line(counts, [0.5 + 1e-3 * n for n in counts]) == pytest.approx((0.5, 1e-3))
    assert minutes._fit_line(counts, [2 - 1e-3 * n for n in counts]) == (pytest.approx(1.16), 0.0)
    assert minutes._fit_line([7] * 9, [0.1] * 9) == (pytest.approx(0.1), 0.0)


def test_rounding_makes_no_intercept_of_a_linear_fit_negative():
    """From the first to the last count, the times of these lines grow as fast as a line through the origin allows."""
    for seconds in np.linspace(0.001, 0.01, 500):
        intercept, _ = minutes._fit_line([100, 4999], [0.0, float(seconds)])
        assert intercept >= 0


@pytest.mark.acceptance
def test_measuring_a_scene_gives_its_cost(scene):
    cost = minutes.measure_scene_cost(scene, make_plan(), CPU_DEVICE, 0, PictureCache(), 5.0)
    assert (
        cost.step_seconds >= 0
        and cost.step_seconds_per_gaussian >= 0
        and cost.step_seconds + cost.step_seconds_per_gaussian > 0
    )
    assert cost.cpu_pass_seconds > 0 and cost.decoding_seconds >= 0 and cost.gaussians > 0


def fitted_plan(
    posed: Path, scene: Scene, requested: Plan, seconds: float, load_settings: LoadSettings | None = None
) -> Plan:
    """Return the plan that fits into this time."""
    reporter = Reporter(["training"], ignore_progress)
    end, settings = monotonic() + seconds, load_settings or LoadSettings()
    return fit_plan_to_minutes(posed, settings, scene, requested, CPU_DEVICE, end, 0, PictureCache(), reporter)


def test_large_photos_are_reduced_when_time_is_short(posed, scene, monkeypatch, caplog):
    def cost(scene, requested, *_):
        return SceneCost(5e-4 * scene.train[0].camera.width ** 2, 0.0, 0.0, 0.0, 100, requested)

    monkeypatch.setattr(minutes, "measure_scene_cost", cost)
    monkeypatch.setattr(minutes, "CANDIDATE_PHOTO_SIZES", (28, 24, 16))

    def planned(seconds: float) -> Plan:
        return fitted_plan(posed, scene, make_plan(90_000), seconds)

    plans = [planned(seconds) for seconds in (3000.0, 300.0, 100.0)]
    assert [plan.max_size for plan in plans] == [1600, 24, 16] and {plan.target_bytes for plan in plans} == {90_000}
    assert plans[0].steps > 1000 and any("pixels" in sentence for sentence in caplog.messages)


def test_photos_that_are_small_already_are_timed_at_the_size_asked_for(posed, scene, monkeypatch):
    timed: list[int] = []

    def cost(scene, requested, *_):
        timed.append(max(scene.train[0].camera.width, scene.train[0].camera.height))
        return SceneCost(1e-3, 0.0, 0.0, 0.0, 100, requested)

    monkeypatch.setattr(minutes, "measure_scene_cost", cost)
    monkeypatch.setattr(minutes, "CANDIDATE_PHOTO_SIZES", (24, 16, 8))
    load_settings = LoadSettings(max_size=32)
    fitted_plan(posed, load_settings.load(posed), make_plan(90_000), 3000.0, load_settings)
    assert timed == [32]


def test_a_long_run_has_the_measured_budget_and_a_short_one_the_default(posed, scene, monkeypatch):
    monkeypatch.setattr(
        minutes, "measure_scene_cost", lambda _, requested, *__: SceneCost(0.0, 1e-5, 0.0, 0.0, 100, requested)
    )
    monkeypatch.setattr(decisions, "measure_budget", lambda *_: (0.5, "by a coin"))

    def planned(seconds: float, target_bytes: int | None = None) -> Plan:
        return fitted_plan(posed, scene, make_plan(target_bytes), seconds)

    short, long, targeted = planned(60.0), planned(600.0), planned(600.0, 90_000)
    assert short.steps < decisions.MIN_BUDGET_STEPS <= long.steps
    assert (short.budget_factor, long.budget_factor, targeted.budget_factor) == (1.0, 0.5, None)
    monkeypatch.setattr(decisions, "measures_budget", lambda *_: False)
    assert planned(600.0).steps < 0.8 * long.steps


def test_too_little_time_gives_a_draft_with_a_note(posed, scene, caplog):
    for seconds in (-1.0, 0.5):
        plan = fitted_plan(posed, scene, make_plan(20_000), seconds)
        assert (plan.steps, plan.target_bytes) == (6, 20_000)
    first, *_, last = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert "no time is left for training" in first and "the time is short" in last


def test_an_explicit_number_of_gaussians_replaces_the_measured_budget(posed, scene, monkeypatch):
    monkeypatch.setattr(
        minutes, "measure_scene_cost", lambda _, requested, *__: SceneCost(0.0, 1e-5, 0.0, 0.0, 100, requested)
    )
    monkeypatch.setattr(decisions, "measure_budget", None)
    plan = fitted_plan(posed, scene, make_plan(max_gaussians=700), 600)
    assert (plan.train_config(0).max_gaussians, plan.budget_factor) == (700, None)


def test_photos_are_never_larger_than_asked_for(posed, scene, monkeypatch):
    monkeypatch.setattr(
        minutes, "measure_scene_cost", lambda _, requested, *__: SceneCost(1e-3, 0.0, 0.0, 0.0, 100, requested)
    )
    load_settings = LoadSettings(max_size=24)
    for seconds in (600.0, -1.0):
        assert fitted_plan(posed, load_settings.load(posed), make_plan(90_000), seconds, load_settings).max_size == 24


@pytest.mark.usefixtures("fake_stages")
def test_the_measured_cost_is_kept_by_the_next_call(posed, tmp_path, monkeypatch):
    first = make_scene(posed, tmp_path / "scene.hyrf", MakeConfig(minutes=0.01))
    assert list(first.seconds)[0] == "measurement"
    monkeypatch.setattr(minutes, "measure_scene_cost", None)
    assert "measurement" in make_scene(posed, tmp_path / "scene.ply", MakeConfig(minutes=0.01)).kept


@pytest.mark.usefixtures("fake_stages")
def test_with_a_kept_measurement_the_remaining_time_is_estimated_again(posed, tmp_path, monkeypatch):
    make_scene(posed, tmp_path / "scene.hyrf", MakeConfig(minutes=0.01))
    (tmp_path / "scene.work" / "run" / "model.hyrf").unlink()
    parts = ("pilots", "teachers", "training", "results", "compression", "scoring", "export")
    monkeypatch.setattr("hyrfpack.make.run.estimate_scene_seconds", lambda *_: dict.fromkeys(parts, 1234.0))
    events: list[StageEvent] = []
    context = RunContext(progress=events.append)
    assert make_scene(posed, tmp_path / "scene.ply", MakeConfig(minutes=0.01), context=context).kept[0] == "measurement"
    first = next(event for event in events if event.stage == "training")
    assert first.seconds_left is not None and first.seconds_left >= 1234

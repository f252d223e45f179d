"""Pilot runs decide on exposure compensation, and the main run keeps the decision."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
import torch
from pilot_runs import CPU_DEVICE, LONG_CONFIG, interrupt_at, make_scene, mask_all_pixels
from scenes import QUIET_CONTEXT, ball_scene

from hyrfpack.data import PictureCache
from hyrfpack.format.exposure_header import STOPS_PER_LOG_GAIN
from hyrfpack.model.exposure import apply_exposure_gains
from hyrfpack.scene import Scene, View
from hyrfpack.train import TrainConfig, decisions, exposure_pilots, pilots, train_model
from hyrfpack.train.decisions import (
    MIN_BUDGET_STEPS,
    MIN_EXPOSURE_STEPS,
    Decisions,
    decide,
    max_pilot_steps,
    measures_exposure,
)
from hyrfpack.train.exposure_pilots import measure_exposure
from hyrfpack.train.pilots import ScenePilots


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


@pytest.mark.parametrize(("positions", "folds"), [((0, 1, 2, 3, 3, 3, 3, 3, 3), 4), ((0, 0, 0, 1, 1, 1, 2, 2, 2), 3)])
def test_photos_that_share_positions_validate_once_and_in_further_folds(monkeypatch, positions, folds):
    """Photos of one position are in one fold, so that other folds may hold few photos."""
    monkeypatch.setattr(exposure_pilots, "estimate_exposure_spread", lambda *_: 1.0)
    scene = make_scene(9)
    poses = [scene.train[number].camera.camera_from_world for number in positions]
    views = [
        dataclasses.replace(view, camera=dataclasses.replace(view.camera, camera_from_world=pose))
        for view, pose in zip(scene.train, poses, strict=True)
    ]
    validated: list[list[str]] = []

    def gain(pilots: ScenePilots, number: int, *_: object) -> list[float]:
        fold = pilots.fold(exposure_pilots.EXPOSURE_VALIDATION_EVERY, 16, number)
        validated.append([view.name for view in fold.validation])
        return [1.0 + 0.5 * (-1) ** n for n in range(len(fold.validation))]

    monkeypatch.setattr(exposure_pilots, "_gain_per_view", gain)
    runs = ScenePilots(dataclasses.replace(scene, train=views), LONG_CONFIG, PictureCache(), CPU_DEVICE)
    decision, _ = measure_exposure(runs)
    names = [name for fold in validated for name in fold]
    assert decision and len(validated) <= folds and 6 <= len(set(names)) == len(names)


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

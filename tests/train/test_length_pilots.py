"""Pilot runs choose the number of steps of long runs on few photos."""

from __future__ import annotations

import dataclasses

import pytest
from pilot_runs import CPU_DEVICE, assert_resume_is_rejected, interrupt_at, make_scene, mask_all_pixels
from scenes import QUIET_CONTEXT

from hyrfpack.data import PictureCache
from hyrfpack.train import TrainConfig, decisions, length_pilots, train_model
from hyrfpack.train.checkpoint import read_asked_steps
from hyrfpack.train.decisions import measures_length
from hyrfpack.train.length_pilots import measure_length
from hyrfpack.train.pilots import ScenePilots
from hyrfpack.train.setup import budget_for


def measure_scene_length(steps: int) -> tuple[int, str, ScenePilots]:
    """Choose the number of steps of a run of at most `steps`; also return its pilots."""
    runs = ScenePilots(make_scene(), TrainConfig(steps=steps), PictureCache(), CPU_DEVICE)
    return *measure_length(runs, exposure=True, budget_factor=0.5), runs


@pytest.mark.parametrize(
    ("by_steps", "steps", "chosen", "measured"),
    [
        ({3000: 20.0, 7000: 19.8}, 7_000, 3_000, [3_000, 7_000]),
        ({3000: 20.0, 7000: 20.0}, 7_000, 3_000, [3_000, 7_000]),
        ({3000: 20.0, 7000: 20.1}, 7_000, 7_000, [3_000, 7_000]),
        ({3000: 20.0, 10000: 19.9}, 30_000, 3_000, [3_000, 10_000]),
        ({3000: 20.0, 10000: 20.1, 30000: 19.0}, 30_000, 10_000, [3_000, 10_000, 30_000]),
    ],
)
def test_a_longer_run_is_chosen_only_while_validation_photos_score_higher(scores, by_steps, steps, chosen, measured):
    scores |= by_steps
    choice, reason, runs = measure_scene_length(steps)
    assert choice == chosen
    assert [score.steps for score in runs.scores] == measured and all(score.exposure for score in runs.scores)
    assert all(f"{length:,} steps {by_steps[length]:.2f} dB, 0.500" in reason for length in measured)


@pytest.mark.parametrize(("psnr", "ssim", "chosen"), [(19.9, 0.803, 7_000), (19.9, 0.802, 3_000), (20.1, 0.797, 3_000)])
def test_ssim_counts_in_the_choice_of_the_length(scores, psnr, ssim, chosen):
    scores |= {3000: (20.0, 0.8), 7000: (psnr, ssim)}
    choice, reason, _ = measure_scene_length(7_000)
    assert choice == chosen and f"7,000 steps {psnr:.2f} dB, {ssim:.3f}" in reason


def test_each_length_pilot_has_the_budget_of_a_run_of_its_length(scores):
    scores |= {3000: 20.0, 7000: 20.1}
    _, _, runs = measure_scene_length(7_000)
    training = runs.fold(4).scene
    assert [score.max_gaussians for score in runs.scores] == [
        budget_for(training, TrainConfig(steps=steps, budget_factor=0.5))[0] for steps in (3_000, 7_000)
    ]


def test_photos_without_validation_photos_get_the_whole_run():
    scene = make_scene()
    masked = dataclasses.replace(scene, train=[mask_all_pixels(view) for view in scene.train])
    runs = ScenePilots(masked, TrainConfig(steps=7_000), PictureCache(), CPU_DEVICE)
    assert measure_length(runs, exposure=False, budget_factor=None) == (
        7_000,
        "7,000: masks leave no pixel of the validation photos",
    )
    assert not runs.scores


@pytest.mark.parametrize(
    ("steps", "lengths"), [(6_000, [3_000, 6_000]), (19_999, [3_000, 19_999]), (20_000, [3_000, 10_000, 20_000])]
)
def test_pilots_are_at_most_half_as_long_as_the_run(steps, lengths):
    assert length_pilots.pilot_lengths(steps) == lengths


@pytest.mark.parametrize(
    ("change", "views", "expected"),
    [
        ({}, 8, True),
        ({}, 30, True),
        ({}, 7, False),
        ({}, 31, False),
        ({"steps": 6_000}, 8, True),
        ({"steps": 5_999}, 8, False),
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

    monkeypatch.setattr(length_pilots, "PILOT_LENGTHS_STEPS", (8,))
    assert_resume_is_rejected(tmp_path, dataclasses.replace(config, steps=20))
    assert train_model(make_scene(), tmp_path, config, resume=True, context=QUIET_CONTEXT).step == 8


@pytest.mark.parametrize(("asked", "steps"), [(7_000, 3_000), (None, 3_000), (6_000, 7_000), (3_000, 7_000)])
def test_a_shorter_length_counts_as_chosen_only_for_the_steps_that_were_asked_for(asked, steps):
    assert decisions.chosen_steps(make_scene(), TrainConfig(steps=7_000), 3_000, asked) == steps


def test_scores_of_length_pilots_state_the_steps_that_were_asked_for(scores):
    scores |= {3000: 20.0, 7000: 19.8}
    chosen, reason, runs = measure_scene_length(7_000)
    run = {"choices": {"steps": reason}, "pilots": [dataclasses.asdict(score) for score in runs.scores]}
    assert (chosen, read_asked_steps(run, chosen)) == (3_000, 7_000)

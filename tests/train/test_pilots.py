"""What two short runs make of a scene, and that the run they were for keeps to it."""

from __future__ import annotations

import dataclasses
import json
import signal
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scenes import ball_scene

from hyrfpack.data import PictureCache
from hyrfpack.errors import HyrfTrainingError
from hyrfpack.scene import Scene, View
from hyrfpack.train import TrainConfig, pilots, train
from hyrfpack.train.pilots import FACTORS, measure_budget, measures_budget

CPU = torch.device("cpu")
LONG = TrainConfig(steps=pilots.LEAST_STEPS)


def a_scene(views: int = 10) -> Scene:
    return ball_scene(views=views, points=60, side=24)


def measured(scene: Scene, config: TrainConfig = LONG, **options) -> tuple[float, str] | None:
    return measure_budget(scene, config, PictureCache(), CPU, **options)


@pytest.fixture
def short(monkeypatch) -> None:
    """Pilots before runs of ten steps, and short ones."""
    monkeypatch.setattr(pilots, "LEAST_STEPS", 10)
    monkeypatch.setattr(pilots, "PILOT_STEPS", 6)


@pytest.fixture
def scores(monkeypatch) -> dict[int, float]:
    """What models score, by their Gaussians at most; they are not trained."""
    table: dict[int, float] = {}

    class Untrained:
        def __init__(self, scene, config, cache, device):
            self.model = config.max_gaussians

        def run(self, report, stop):
            pass

    monkeypatch.setattr(pilots, "Trainer", Untrained)
    monkeypatch.setattr(pilots, "evaluate", lambda model, views, report: SimpleNamespace(psnr_corrected=table[model]))
    return table


@pytest.mark.parametrize(
    ("gain", "factor"),
    [(-1.0, 0.25), (0.0, 0.25), (0.29, 0.25), (0.31, 0.35), (0.5, 0.5), (0.8, 0.7), (1.2, 1.0), (1.3, 1.5), (9.0, 1.5)],
)
def test_a_scene_gets_gaussians_in_proportion_to_what_two_doublings_bring(scores, gain, factor):
    gain *= pilots.EXPECTED
    scores |= {1250: 20.0, 5000: 20.0 + gain}
    why = f"in {pilots.PILOT_STEPS} steps 5,000 Gaussians scored {gain:+.2f} dB over 1,250"
    assert measured(a_scene()) == (factor, why)


@pytest.mark.parametrize(("first", "second", "factor"), [(0.1, 0.9, 0.5), (0.9, 0.1, 0.5), (1.0, 0.0, 1.0)])
def test_what_would_make_the_model_smaller_is_asked_twice(monkeypatch, scores, first, second, factor):
    gains = {0: first * pilots.EXPECTED, 1: second * pilots.EXPECTED}
    seeds: list[int] = []

    class Seeded(pilots.Trainer):  # the one of `scores`
        def __init__(self, scene, config, cache, device):
            self.model = 20 + gains[config.seed] * (config.max_gaussians == 5000)
            seeds.append(config.seed)

    monkeypatch.setattr(pilots, "Trainer", Seeded)
    monkeypatch.setattr(pilots, "evaluate", lambda model, views, report: SimpleNamespace(psnr_corrected=model))
    assert measured(a_scene())[0] == factor
    assert seeds == ([0, 0] if first >= 1 else [0, 0, 1, 1])


@pytest.mark.parametrize(
    ("change", "views", "expected"),
    [
        ({}, 8, True),
        ({}, 7, False),
        ({"steps": pilots.LEAST_STEPS - 1}, 8, False),
        ({"max_gaussians": 500}, 8, False),
        ({"target_bytes": 50_000}, 8, False),
        ({"budget_factor": 1.0}, 8, False),
    ],
)
def test_it_is_measured_where_nobody_has_said_and_there_is_time_and_photos_enough(change, views, expected):
    assert measures_budget(a_scene(views), dataclasses.replace(LONG, **change)) is expected


@pytest.mark.parametrize("views", [8, 13, 15, 16, 100, 1000])
def test_photos_to_judge_by_are_not_trained_on_and_lie_among_those_that_are(views):
    near, judges = pilots.split(range(views))
    assert not set(near) & set(judges) and set(near) | set(judges) <= set(range(views))
    assert near == sorted(near) and len(near) == min(pilots.PILOT_STEPS, views - len(judges))
    assert 1 <= len(judges) <= pilots.JUDGES
    assert all(min(abs(judge - n) for n in near) == 1 for judge in judges)


@pytest.mark.usefixtures("short")
def test_pilots_say_the_same_twice_and_report_each_step():
    told: list[tuple] = []
    first = measured(a_scene(), report=lambda *facts: told.append(facts))
    assert first == measured(a_scene())
    assert first is not None and first[0] in FACTORS
    assert [step for step, *_ in told] in (list(range(1, 13)), list(range(1, 25)))
    assert all(np.isfinite(loss) and mse > 0 and gaussians > 0 for _, loss, mse, gaussians in told)


@pytest.mark.usefixtures("short")
def test_pilots_end_where_they_are_asked_to():
    told: list[int] = []
    assert measured(a_scene(), report=lambda step, *_: told.append(step), stop=lambda: len(told) >= 8) is None
    assert told[-1] == 8


@pytest.mark.usefixtures("short")
@pytest.mark.parametrize("left", [0, 1])
def test_photos_that_masks_leave_nothing_of_do_not_judge(left, monkeypatch):
    judged: list[list[str]] = []
    monkeypatch.setattr(
        pilots,
        "evaluate",
        lambda _, views, report: judged.append([view.name for view in views]) or SimpleNamespace(psnr_corrected=20.0),
    )
    scene = a_scene()
    judges = [view.name for view in pilots.split(scene.train)[1]]
    views = [masked(view) if view.name in judges[left:] else view for view in scene.train]
    factor, why = measured(dataclasses.replace(scene, train=views))
    if left:
        assert judged == [judges[:1]] * 4  # no gain: asked twice
    else:
        assert (factor, why) == (1.0, "masks leave nothing of the photos to judge by") and not judged


def masked(view: View) -> View:
    picture = view.load()
    nothing = dataclasses.replace(picture, mask=np.zeros(picture.rgb.shape[:2], bool))
    return dataclasses.replace(view, load=lambda: nothing)


@pytest.mark.usefixtures("short")
def test_a_run_has_the_budget_that_pilots_tell_and_says_why(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("hyrfpack.train.run.measure_budget", lambda *_: (0.5, "by a coin"))
    train(a_scene(), tmp_path, TrainConfig(steps=10))
    metrics = json.loads((tmp_path / "metrics.json").read_bytes())
    assert metrics["settings"]["budget_factor"] == 0.5
    reason = metrics["choices"]["max_gaussians"]
    assert reason.startswith("2,500: 0.5 times what suits ") and reason.endswith(" steps: by a coin")
    assert f"Gaussians at most: {reason}" in capsys.readouterr().err


def interrupted_at(step: int):
    """A report that interrupts as a person does, once."""
    left = [step]

    def report(step: int, loss: float, mse: float, gaussians: int) -> None:
        if left and step == left[0]:
            left.clear()
            signal.raise_signal(signal.SIGTERM)

    return report


@pytest.mark.usefixtures("short", "signals")
def test_a_run_that_goes_on_keeps_its_budget_and_the_reason(tmp_path, monkeypatch):
    config = TrainConfig(steps=10)
    train(a_scene(), tmp_path / "whole", config, quiet=True)
    assert train(a_scene(), tmp_path / "again", config, report=interrupted_at(6)).step == 6

    monkeypatch.setattr("hyrfpack.train.run.measure_budget", lambda *_: pytest.fail("measured again"))
    for asked in ({"max_gaussians": 5_000}, {"target_bytes": 20_000}, {"budget_factor": 0.9}):
        with pytest.raises(HyrfTrainingError, match="started with other settings"):
            train(a_scene(), tmp_path / "again", dataclasses.replace(config, **asked), resume=True, quiet=True)
    train(a_scene(), tmp_path / "again", config, resume=True, quiet=True)

    whole, again = (json.loads((tmp_path / name / "metrics.json").read_bytes()) for name in ("whole", "again"))
    assert whole["settings"] == again["settings"] and whole["choices"] == again["choices"]
    assert "scored" in whole["choices"]["max_gaussians"]
    assert (tmp_path / "whole/model.hyrf").read_bytes() == (tmp_path / "again/model.hyrf").read_bytes()


@pytest.mark.usefixtures("short", "signals")
def test_an_interrupt_before_the_first_step_leaves_nothing(tmp_path):
    result = train(a_scene(), tmp_path, TrainConfig(steps=10), report=interrupted_at(0))
    assert (result.complete, result.step, result.model, result.metrics) == (False, 0, None, {})
    assert not any(tmp_path.iterdir())


@pytest.mark.usefixtures("short")
def test_the_report_hears_of_pilots_as_step_nought(tmp_path):
    steps: list[int] = []
    train(a_scene(), tmp_path, TrainConfig(steps=10), report=lambda step, *_: steps.append(step))
    assert steps[-10:] == list(range(1, 11)) and steps[:-10] in ([0] * 12, [0] * 24)


@pytest.mark.usefixtures("short")
def test_pilot_runs_tell_each_step_and_each_view_that_is_scored():
    told: list[tuple[str, int, int]] = []
    measured(a_scene(), phase=lambda *progress: told.append(progress))
    assert [row for row in told if row[0] == "pilot run 1 of 2: training"] == [
        ("pilot run 1 of 2: training", step, 6) for step in range(1, 7)
    ]
    assert [row for row in told if row[0] == "pilot run 2 of 2: scoring"] == [
        ("pilot run 2 of 2: scoring", done, 2) for done in range(3)
    ]

"""What two short runs make of a scene, and that the run they were for keeps to it."""

from __future__ import annotations

import dataclasses
import json
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scenes import ball_scene

from hyrfpack.data import PictureCache
from hyrfpack.scene import Scene
from hyrfpack.train import TrainConfig, pilots, train
from hyrfpack.train.pilots import measure_share, measures_share

CPU = torch.device("cpu")
LONG = TrainConfig(steps=pilots.LEAST_STEPS)


def a_scene(views: int = 10) -> Scene:
    return ball_scene(views=views, points=60, side=24)


def measured(scene: Scene, config: TrainConfig = LONG, **options) -> tuple[float, str]:
    return measure_share(scene, config, PictureCache(), CPU, **options)


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

        def run(self, report):
            pass

    monkeypatch.setattr(pilots, "Trainer", Untrained)
    monkeypatch.setattr(pilots, "evaluate", lambda model, views: SimpleNamespace(psnr_corrected=table[model]))
    return table


@pytest.mark.parametrize(
    ("gain", "share"), [(-1.0, pilots.LEAST), (0.0, pilots.LEAST), (0.8, 0.8), (1.5, 1.5), (9.0, pilots.MOST)]
)
def test_a_scene_gets_gaussians_in_proportion_to_what_two_doublings_bring(scores, gain, share):
    scores |= {1250: 20.0, 5000: 20.0 + gain * pilots.EXPECTED}
    found, why = measured(a_scene())
    assert found == pytest.approx(share)
    assert why == f"in {pilots.PILOT_STEPS} steps 5,000 Gaussians scored {gain * pilots.EXPECTED:+.2f} dB over 1,250"


@pytest.mark.parametrize(
    ("change", "views", "expected"),
    [
        ({}, 8, True),
        ({}, 7, False),
        ({"steps": pilots.LEAST_STEPS - 1}, 8, False),
        ({"max_gaussians": 500}, 8, False),
        ({"target_bytes": 50_000}, 8, False),
        ({"share": 1.0}, 8, False),
    ],
)
def test_it_is_measured_where_nobody_has_said_and_there_is_time_and_photos_enough(change, views, expected):
    assert measures_share(a_scene(views), dataclasses.replace(LONG, **change)) is expected


@pytest.mark.parametrize("views", [8, 15, 16, 100, 1000])
def test_photos_to_judge_by_are_not_trained_on(views):
    rest, judges = pilots._split(range(views))
    assert not set(rest) & set(judges) and set(rest) | set(judges) <= set(range(views))
    assert 1 <= len(judges) <= pilots.JUDGES and min(pilots.PILOT_STEPS, 0.7 * views) <= len(rest) <= pilots.PILOT_STEPS


@pytest.mark.usefixtures("short")
def test_pilots_say_the_same_twice_and_report_each_step():
    told: list[tuple] = []
    first = measured(a_scene(), report=lambda *facts: told.append(facts))
    assert first == measured(a_scene())
    assert pilots.LEAST <= first[0] <= pilots.MOST
    assert [step for step, *_ in told] == list(range(1, 13))
    assert all(np.isfinite(loss) and mse > 0 and gaussians > 0 for _, loss, mse, gaussians in told)


@pytest.mark.usefixtures("short")
def test_nothing_is_measured_by_photos_that_masks_leave_nothing_of():
    scene = a_scene()
    judges = {view.name for view in pilots._split(scene.train)[1]}
    blank = [_masked(view) if view.name in judges else view for view in scene.train]
    assert measured(dataclasses.replace(scene, train=blank)) == (
        1.0,
        "not measured: masks leave nothing of the photos to judge by",
    )


def _masked(view):
    picture = view.load()
    nothing = dataclasses.replace(picture, mask=np.zeros(picture.rgb.shape[:2], bool))
    return dataclasses.replace(view, load=lambda: nothing)


@pytest.mark.usefixtures("short")
def test_a_run_has_the_share_that_pilots_tell_and_says_why(tmp_path, monkeypatch):
    monkeypatch.setattr("hyrfpack.train.run.measure_share", lambda *_: (0.5, "by a coin"))
    train(a_scene(), tmp_path, TrainConfig(steps=10), quiet=True)
    metrics = json.loads((tmp_path / "metrics.json").read_bytes())
    assert metrics["settings"]["share"] == 0.5
    assert metrics["choices"]["max_gaussians"].startswith("2,500: 0.5 times what suits ")
    assert metrics["choices"]["max_gaussians"].endswith(" steps: by a coin")


@pytest.mark.usefixtures("short")
def test_a_run_that_goes_on_keeps_its_share_and_the_reason(tmp_path, monkeypatch):
    config = TrainConfig(steps=10, checkpoint_every=4)
    train(a_scene(), tmp_path / "whole", config, quiet=True)

    def interrupt(step, loss, mse, gaussians):
        if step == 6:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(a_scene(), tmp_path / "again", config, report=interrupt)
    monkeypatch.setattr("hyrfpack.train.run.measure_share", lambda *_: pytest.fail("measured again"))
    train(a_scene(), tmp_path / "again", config, resume=True, quiet=True)

    whole, again = (json.loads((tmp_path / name / "metrics.json").read_bytes()) for name in ("whole", "again"))
    assert whole["settings"] == again["settings"] and whole["choices"] == again["choices"]
    assert "scored" in whole["choices"]["max_gaussians"]
    assert (tmp_path / "whole/model.hyrf").read_bytes() == (tmp_path / "again/model.hyrf").read_bytes()


@pytest.mark.usefixtures("short")
def test_the_report_hears_of_pilots_as_step_nought(tmp_path):
    steps: list[int] = []
    train(a_scene(), tmp_path, TrainConfig(steps=10), report=lambda step, *_: steps.append(step))
    assert steps == [0] * 12 + list(range(1, 11))

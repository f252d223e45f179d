"""Runs on few photos are trained on virtual views, too: renders of teachers between the photos."""

from __future__ import annotations

import dataclasses
import json
import signal
from pathlib import Path

import numpy as np
import pytest
import torch
from pilot_runs import interrupt_at, make_scene
from scenes import QUIET_CONTEXT, ball_points, ball_scene, ring, small_model

from hyrfpack.context import RunContext
from hyrfpack.data import PictureCache
from hyrfpack.errors import HyrfError
from hyrfpack.format.run_folder import TEACHER_FILES
from hyrfpack.model import HybridModel
from hyrfpack.progress import Event, TaskEvent
from hyrfpack.render import RenderSettings, render_view
from hyrfpack.train import TrainConfig, Trainer, decisions, results, teachers, train_model
from hyrfpack.train.exposure_map import fit_exposure_map
from hyrfpack.train.resolution import PhotoSize
from hyrfpack.train.run import is_begun
from hyrfpack.train.teachers import MAX_VIRTUAL_VIEW_PHOTOS, count_teachers
from hyrfpack.train.virtual_views import render_virtual_views

TAUGHT_CONFIG = TrainConfig(steps=10, max_gaussians=60, exposure=False)
SMALL_PHOTOS, LARGE_PHOTOS = (PhotoSize(width * height, height) for width, height in ((480, 320), (1600, 1200)))


@pytest.fixture
def short_teachers(monkeypatch) -> None:
    """Runs of ten steps have teachers, too, of four steps."""
    monkeypatch.setattr(teachers, "usual_steps", lambda _: 10)
    monkeypatch.setattr(teachers, "TEACHER_STEPS", 4)


def interrupt_teacher(number: int, step: int) -> RunContext:
    """Return a context that sends SIGTERM after a step of a teacher run."""

    def interrupt(event: Event) -> None:
        if isinstance(event, TaskEvent) and event.task == f"teacher run {number}/3: training" and event.done == step:
            signal.raise_signal(signal.SIGTERM)

    return RunContext(progress=interrupt)


def follow_teachers(numbers: list[int]) -> RunContext:
    """Return a context that adds the number of each teacher run that takes a step to a list."""

    def follow(event: Event) -> None:
        if isinstance(event, TaskEvent) and event.task.startswith("teacher run") and event.done == 1:
            numbers.append(int(event.task.removeprefix("teacher run ")[0]))

    return RunContext(progress=follow)


def left_teachers(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir() if path.name in TEACHER_FILES)


def read_model(folder: Path) -> bytes:
    return (folder / "model.hyrf").read_bytes()


def teacher(seed: int = 0, **settings) -> HybridModel:
    return small_model(ball_points(40)[0], fields=0.5, scale_logits=-2.0, seed=seed, **settings)


# -- rendering -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("background", "solid"), [(False, (0.0, 0.0, 0.0)), (True, (0.0, 0.0, 0.0)), (False, (1.0, 0.9, 0.2))]
)
def test_a_virtual_view_is_the_mean_render_at_one_exposure(background, solid):
    models = [teacher(seed, background=background, solid=solid) for seed in (0, 1)]
    cameras = ring(5)
    poses = [models[0].config.frame.local_pose(camera) for camera in cameras]
    models[0].exposure = fit_exposure_map(poses, np.random.default_rng(0).normal(0, 0.7, (5, 3))).map
    views = render_virtual_views(models, cameras)
    assert [view.name for view in views] == [f"virtual/{number}" for number in range(5)]
    for view in views:
        renders = [render_view(model, view.camera, RenderSettings(exposure="consistent")) for model in models]
        picture, shown = view.load(), torch.stack([render.rgb for render in renders]).mean(0)
        assert (picture.alpha is None) == background
        colors = torch.from_numpy(picture.composite(np.array(solid, np.float32)))
        torch.testing.assert_close(colors.float(), shown, rtol=0, atol=1.5 / 255)


def test_virtual_views_lie_between_cameras_in_the_same_places_for_the_same_seed():
    cameras = ring(6)
    first, again, other = (render_virtual_views([teacher()], cameras, seed) for seed in (0, 0, 1))
    positions = [np.array([view.camera.position for view in views]) for views in (first, again, other)]
    assert np.array_equal(positions[0], positions[1]) and not np.array_equal(positions[0], positions[2])
    assert len(np.unique(positions[0], axis=0)) == 6
    places = np.array([camera.position for camera in cameras])
    distances = np.linalg.norm(positions[0][:, None] - places, axis=2)
    assert distances.min() > 0 and (distances.argmin(1) < 6).all()
    assert (np.linalg.norm(positions[0], axis=1) <= np.linalg.norm(places[0]) + 1e-9).all()


def test_virtual_views_of_large_photos_are_smaller():
    cameras = ring(2, width=1200, height=900)
    camera = render_virtual_views([teacher()], cameras)[0].camera
    assert (camera.width, camera.height) == (1155, 866) and camera.fx == pytest.approx(cameras[0].fx * 1155 / 1200)


# -- a run -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("photos", "size", "steps", "expected"),
    [
        (MAX_VIRTUAL_VIEW_PHOTOS, SMALL_PHOTOS, 3_000, 3),
        (2, SMALL_PHOTOS, 3_000, 3),
        (1, SMALL_PHOTOS, 3_000, 0),
        (MAX_VIRTUAL_VIEW_PHOTOS + 1, SMALL_PHOTOS, 3_000, 0),
        (8, SMALL_PHOTOS, 2_999, 0),
        (8, LARGE_PHOTOS, 2_000, 3),
        (8, LARGE_PHOTOS, 1_999, 0),
    ],
)
def test_only_runs_of_usual_length_on_few_photos_have_teachers(photos, size, steps, expected):
    config = TrainConfig(steps=steps)
    assert count_teachers(photos, size, config) == expected
    assert count_teachers(photos, size, dataclasses.replace(config, virtual_views=False)) == 0


@pytest.mark.parametrize(
    ("measured", "virtual_views", "chosen"), [(0.25, True, 0.5), (0.25, False, 0.25), (0.7, True, 0.7)]
)
def test_runs_with_virtual_views_have_at_least_half_of_the_usual_budget(measured, virtual_views, chosen, monkeypatch):
    monkeypatch.setattr(decisions, "measure_budget", lambda *_: (measured, "the larger pilot scored as much"))
    config = TrainConfig(steps=3_000, exposure=False, early_stop=False, virtual_views=virtual_views)
    scene = ball_scene(views=8, points=60, side=24)
    made = decisions.decide(scene, config, PictureCache(2**20), torch.device("cpu"))
    assert made.config.budget_factor == chosen
    assert ("the least with virtual views" in made.reasons["max_gaussians"]) == (chosen != measured)


def test_steps_take_photos_and_virtual_views_in_turn_and_the_last_ones_photos():
    scene = ball_scene(views=4, points=60, side=24)
    virtual = render_virtual_views([teacher()], [view.camera for view in scene.train])
    trainer = Trainer(scene, dataclasses.replace(TAUGHT_CONFIG, steps=30, exposure=True), virtual=virtual)
    names = [view.name for step in range(1, 31) for view in trainer._views_of_step(step)]
    photos, every = (sorted(view.name for view in views) for views in (scene.train, [*scene.train, *virtual]))
    assert sorted(names[:8]) == sorted(names[8:16]) == every
    assert any(name.startswith("virtual/") for name in names[16:25]) and set(names[25:]) <= set(photos)
    assert [view.name for view in trainer._order()] == names
    trainer.run(stop=lambda: trainer.step == 26)
    assert [view.name for view in trainer._order()] == names[26:]
    trainer.run()
    assert trainer.exposures is not None and len(trainer.exposures.to_dict()) == 4
    assert trainer.model.exposure is not None


@pytest.mark.usefixtures("short_teachers")
def test_a_run_records_its_virtual_views_and_keeps_no_teachers(tmp_path):
    scene = make_scene(6)
    train_model(scene, tmp_path / "taught", TAUGHT_CONFIG, context=QUIET_CONTEXT)
    train_model(
        scene, tmp_path / "alone", dataclasses.replace(TAUGHT_CONFIG, virtual_views=False), context=QUIET_CONTEXT
    )
    taught, alone = (json.loads((tmp_path / name / "metrics.json").read_bytes()) for name in ("taught", "alone"))
    assert taught["choices"]["virtual_views"] == "6, the mean render of 3 runs of 4 steps"
    assert "virtual_views" not in alone["choices"]
    assert read_model(tmp_path / "taught") != read_model(tmp_path / "alone")
    assert not left_teachers(tmp_path / "taught") and not is_begun(tmp_path / "taught")


@pytest.mark.usefixtures("short_teachers", "signals")
def test_a_run_that_is_stopped_in_a_teacher_run_keeps_the_finished_teachers(tmp_path):
    train_model(make_scene(6), tmp_path / "whole", TAUGHT_CONFIG, context=QUIET_CONTEXT)
    again = tmp_path / "again"
    stopped = train_model(make_scene(6), again, TAUGHT_CONFIG, context=interrupt_teacher(2, 2))
    assert not stopped.complete and left_teachers(again) == ["teacher-1.hyrf"] and is_begun(again)
    numbers: list[int] = []
    assert train_model(make_scene(6), again, TAUGHT_CONFIG, resume=True, context=follow_teachers(numbers)).complete
    assert numbers == [2, 3] and read_model(again) == read_model(tmp_path / "whole")


@pytest.mark.usefixtures("short_teachers", "signals")
def test_a_stop_in_the_last_step_of_the_last_teacher_run_is_not_forgotten(tmp_path):
    stopped = train_model(make_scene(6), tmp_path, TAUGHT_CONFIG, context=interrupt_teacher(3, 4))
    assert (stopped.complete, stopped.step) == (False, 0) and left_teachers(tmp_path) == sorted(TEACHER_FILES)


@pytest.mark.usefixtures("short_teachers", "signals")
@pytest.mark.parametrize("damage", [None, "missing", "damaged"])
def test_a_run_that_is_stopped_later_has_the_same_virtual_views_when_it_resumes(tmp_path, damage):
    train_model(make_scene(6), tmp_path / "whole", TAUGHT_CONFIG, context=QUIET_CONTEXT)
    again = tmp_path / "again"
    assert train_model(make_scene(6), again, TAUGHT_CONFIG, context=interrupt_at(6)).step == 6
    assert left_teachers(again) == sorted(TEACHER_FILES)
    if damage == "missing":
        (again / TEACHER_FILES[1]).unlink()
    elif damage == "damaged":
        (again / TEACHER_FILES[1]).write_bytes(b"no model")
    numbers: list[int] = []
    train_model(make_scene(6), again, TAUGHT_CONFIG, resume=True, context=follow_teachers(numbers))
    assert numbers == ([] if damage is None else [2])
    assert read_model(again) == read_model(tmp_path / "whole") and not left_teachers(again)


@pytest.mark.usefixtures("short_teachers", "signals")
def test_a_stop_while_virtual_views_are_rendered_again_reports_the_step_of_the_checkpoint(tmp_path):
    train_model(make_scene(6), tmp_path, TAUGHT_CONFIG, context=interrupt_at(6))

    def interrupt(event: Event) -> None:
        if isinstance(event, TaskEvent) and "virtual views" in event.task:
            signal.raise_signal(signal.SIGTERM)

    stopped = train_model(make_scene(6), tmp_path, TAUGHT_CONFIG, resume=True, context=RunContext(progress=interrupt))
    assert (stopped.complete, stopped.step) == (False, 6)


@pytest.mark.usefixtures("short_teachers")
def test_teachers_stay_as_long_as_the_checkpoint_that_completes_the_results(tmp_path, monkeypatch):
    def refuse(path: Path, *arguments: object, **options: object) -> None:
        raise HyrfError(f"{path}: the disk is full", fix="free space")

    with monkeypatch.context() as patch:
        patch.setattr(results, "write_atomic", refuse)
        assert train_model(make_scene(6), tmp_path, TAUGHT_CONFIG, context=QUIET_CONTEXT).missing
    assert left_teachers(tmp_path) == sorted(TEACHER_FILES) and (tmp_path / "checkpoint.pt").exists()
    numbers: list[int] = []
    train_model(make_scene(6), tmp_path, TAUGHT_CONFIG, resume=True, context=follow_teachers(numbers))
    assert numbers == [] and not left_teachers(tmp_path) and not is_begun(tmp_path)


@pytest.mark.usefixtures("short_teachers", "signals")
def test_teachers_of_other_settings_are_trained_again(tmp_path):
    train_model(make_scene(6), tmp_path, TAUGHT_CONFIG, context=interrupt_teacher(2, 2))
    numbers: list[int] = []
    other = dataclasses.replace(TAUGHT_CONFIG, max_gaussians=50)
    train_model(make_scene(6), tmp_path, other, resume=True, context=follow_teachers(numbers))
    assert numbers == [1, 2, 3]


@pytest.mark.usefixtures("short_teachers")
def test_a_teacher_that_cannot_be_written_is_a_warning(tmp_path, monkeypatch, caplog):
    def refuse(*_: object) -> None:
        raise HyrfError("the disk is full", fix="free space")

    monkeypatch.setattr(teachers, "write_atomic", refuse)
    assert train_model(make_scene(6), tmp_path, TAUGHT_CONFIG, context=QUIET_CONTEXT).complete
    assert caplog.text.count("would repeat this teacher run if it were interrupted") == 3

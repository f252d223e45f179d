"""Runs from few, wrong or no points, and on few, equal or black photos, train to finite models."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from scenes import ball_scene, view_of
from short_runs import SHORT_CONFIG, make_scene, mean_training_psnr

from hyrfpack.scene import Picture, Scene
from hyrfpack.train import TrainConfig, Trainer


def scene_with_points(points) -> Scene:
    scene, points = make_scene(), np.asarray(points, np.float64)
    return dataclasses.replace(scene, points=points, point_colors=np.full((len(points), 3), 0.5, np.float32))


def scene_with_views(views) -> Scene:
    return dataclasses.replace(make_scene(), train=list(views))


def black_scene() -> Scene:
    black = Picture(np.zeros((24, 24, 3), np.uint8))
    return scene_with_views(view_of(view.name, view.camera, black) for view in make_scene().train)


def same_way_scene() -> Scene:
    """Return a scene with the same photo six times."""
    view = make_scene().train[0]
    return scene_with_views(dataclasses.replace(view, name=f"{i}.png") for i in range(6))


def invisible_scene() -> Scene:
    nothing = Picture(np.zeros((24, 24, 3), np.uint8), np.zeros((24, 24), np.uint8))
    views = [view_of(view.name, view.camera, nothing) for view in make_scene().train]
    return dataclasses.replace(scene_with_points(np.zeros((0, 3))), train=views, has_alpha=True)


HARD_STARTS = {
    "all points coincident": lambda: scene_with_points(np.tile([0.1, 0.2, 0.3], (50, 1))),
    "one point": lambda: scene_with_points([[0.0, 0.0, 0.0]]),
    "ten points": lambda: scene_with_points(np.random.default_rng(0).normal(size=(10, 3)) * 0.3),
    "no points": lambda: scene_with_points(np.zeros((0, 3))),
    "points a million units away": lambda: scene_with_points(np.random.default_rng(0).normal(size=(50, 3)) + 1e6),
    "a few points a million units away": lambda: scene_with_points(
        np.vstack([make_scene().points, np.full((5, 3), 1e6)])
    ),
    "points behind every camera": lambda: scene_with_points(np.random.default_rng(0).normal(size=(50, 3)) + (0, 0, 30)),
    "points on the cameras": lambda: scene_with_points([view.camera.position for view in make_scene().train]),
    "one view": lambda: scene_with_views(make_scene().train[:1]),
    "one view and no points": lambda: dataclasses.replace(
        scene_with_points(np.zeros((0, 3))), train=make_scene().train[:1]
    ),
    "black pictures": black_scene,
    "the same view six times": same_way_scene,
    "nothing covered": invisible_scene,
}


# The integration layer trains from these for longer in tests/hard_cases/test_training.py.
STARTS_TESTED_ELSEWHERE = {
    "all points coincident",
    "one point",
    "ten points",
    "points a million units away",
    "one view",
    "one view and no points",
    "the same view six times",
}


@pytest.mark.parametrize(
    "start",
    [
        pytest.param(start, marks=[pytest.mark.acceptance] if start in STARTS_TESTED_ELSEWHERE else [])
        for start in HARD_STARTS
    ],
)
def test_hard_starts_train_to_finite_parameters(start):
    trainer = Trainer(HARD_STARTS[start](), dataclasses.replace(SHORT_CONFIG, steps=20))
    losses = []
    trainer.run(progress=lambda event: losses.append(event.loss))
    assert 1 <= len(trainer.model) <= 160
    assert all(torch.isfinite(p).all() for p in trainer.model.parameters())
    assert np.mean(losses[-4:]) <= np.mean(losses[:4])


def opaque_object_on_a_plain_wall() -> Scene:
    """Return photos as a turntable gives them: no coverage, no points and no background sphere for the wall."""
    return dataclasses.replace(ball_scene(points=0), layout="blender")


@pytest.mark.parametrize(
    ("make", "config", "gain"),
    [
        (lambda: ball_scene(points=12, side=20), TrainConfig(steps=200, max_gaussians=12), 6),
        pytest.param(
            lambda: ball_scene(points=30),
            TrainConfig(steps=300, max_gaussians=500),
            12,
            marks=pytest.mark.acceptance,
        ),
        pytest.param(
            lambda: ball_scene(points=30),
            TrainConfig(steps=300, max_gaussians=500, background=False),
            6,
            marks=pytest.mark.acceptance,
        ),
        pytest.param(
            opaque_object_on_a_plain_wall,
            TrainConfig(steps=400, max_gaussians=500),
            12,
            marks=pytest.mark.acceptance,
        ),
    ],
    ids=["no room", "sphere", "no sphere", "object"],
)
def test_sparse_opaque_scenes_do_not_collapse(make, config, gain):
    trainer = Trainer(make(), config)
    first, before, counts = len(trainer.model), mean_training_psnr(trainer), []
    trainer.run(progress=lambda event: counts.append(event.gaussians))
    assert min(counts) > first / 2
    assert mean_training_psnr(trainer) > before + gain


# Without a warm-up of the fields' learning rate, all of these runs collapse. With one of 10 steps, the last one does.
@pytest.mark.acceptance
@pytest.mark.parametrize(
    ("seed", "budget"),
    [(0, 500), (19, 500), (2, 500), (5, 500), (1, 2000)],
)
def test_random_gaussians_do_not_grow_until_they_fill_the_scene(seed, budget):
    trainer = Trainer(opaque_object_on_a_plain_wall(), TrainConfig(steps=400, max_gaussians=budget, seed=seed))
    before = mean_training_psnr(trainer)
    trainer.run(stop=lambda: trainer.step == 120)
    # The largest scale that a Gaussian in the scene's box can have is 1.
    assert trainer.model.decode_geometry().scales.median() < 0.1
    assert mean_training_psnr(trainer) > before + 8

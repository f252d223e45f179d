"""The distance between neighbouring Gaussians in photos, and learning rates of positions that follow it."""

import dataclasses

import numpy as np
import pytest

from hyrfpack.config.train import POSITION_RATE_SPACING
from hyrfpack.model.frame import Frame
from hyrfpack.scene import View
from hyrfpack.train import LearningRates, TrainConfig, Trainer
from hyrfpack.train.setup import usual_budget_for
from hyrfpack.train.spacing import DEFAULT_SPACING, gaussian_spacing
from tests.scenes import ball_scene, camera_at, photograph, small_model, view_of

NEAR_ORIGIN = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.1], [-0.1, 0.0, 0.1], [0.0, 0.0, -0.1]])


def view_from(distance: float, *, width: int = 32, focal: float = 40.0) -> View:
    """Return a square photo from the negative y axis towards the origin."""
    camera = camera_at((0, -distance, 0), width=width, height=width, focal=focal)
    return view_of("photo", camera, photograph(camera))


def model_at(points: np.ndarray, *, scale: float = 2.0):
    """Return a model whose Gaussians are at world points, in a frame of this scale."""
    frame = Frame((0.0, 0.0, 0.0), scale, (1.0, 1.0, 1.0))
    return small_model(frame.to_local(points), frame=frame)


def test_gaussians_that_fill_a_photo_have_the_spacing_of_a_grid():
    """A grid of 8 x 8 points in a photo of 32 x 32 pixels has one every 4 pixels, of 6 / 40 world units each."""
    places = (np.arange(8) - 3.5) * 4 * 6 / 40
    x, z = np.meshgrid(places, places)
    points = np.stack((x.ravel(), np.zeros(64), z.ravel()), axis=1)
    assert gaussian_spacing(model_at(points), [view_from(6.0)], 64) == pytest.approx(4 * 6 / 40 / 2, rel=1e-6)


def test_four_times_as_many_gaussians_are_half_as_far_apart():
    model, views = model_at(NEAR_ORIGIN), [view_from(6.0)]
    assert gaussian_spacing(model, views, 400) == pytest.approx(gaussian_spacing(model, views, 100) / 2, rel=1e-6)


@pytest.mark.parametrize("factor", [0.5, 3.0])
def test_the_spacing_grows_with_distance_and_depends_on_neither_resolution_nor_the_unit_of_the_world(factor):
    before = gaussian_spacing(model_at(NEAR_ORIGIN), [view_from(4.0)], 50)
    finer = gaussian_spacing(model_at(NEAR_ORIGIN), [view_from(4.0, width=64, focal=80.0)], 50)
    farther = gaussian_spacing(model_at(NEAR_ORIGIN), [view_from(4.0 * factor)], 50)
    rescaled = gaussian_spacing(model_at(factor * NEAR_ORIGIN, scale=2 * factor), [view_from(4.0 * factor)], 50)
    assert finer == pytest.approx(before, rel=1e-6)
    assert farther == pytest.approx(factor * before, rel=1e-6)
    assert rescaled == pytest.approx(before, rel=1e-6)


def test_gaussians_outside_of_a_photo_do_not_count_among_those_that_it_shows():
    outside = np.array([[0.0, 90.0, 80.0], [50.0, 0.0, 0.0], [0.0, -9.0, 0.0], [0.0, 0.0, 60.0]])
    everywhere = model_at(np.concatenate([NEAR_ORIGIN, outside]))
    alone = gaussian_spacing(model_at(NEAR_ORIGIN), [view_from(4.0)], 100)
    assert gaussian_spacing(everywhere, [view_from(4.0)], 200) == pytest.approx(alone, rel=1e-6)


def test_without_a_gaussian_in_a_photo_the_spacing_is_the_default():
    assert gaussian_spacing(model_at(np.array([[0.0, -9.0, 0.0]])), [view_from(4.0)], 10) == DEFAULT_SPACING
    assert gaussian_spacing(model_at(np.zeros((0, 3))), [view_from(4.0)], 10) == DEFAULT_SPACING


def test_of_many_gaussians_and_photos_a_part_is_measured():
    points = np.random.default_rng(0).normal(0, 0.3, (23_456, 3))
    views = [view_from(distance) for distance in np.linspace(4, 8, 250)]
    measured = gaussian_spacing(model_at(points), views, 5_000)
    every_view = [gaussian_spacing(model_at(points[::9]), [view], 5_000) for view in views]
    assert measured == pytest.approx(np.median(every_view), rel=0.02)


def test_training_learns_at_the_rates_of_its_spacing():
    scene = ball_scene()
    trainer = Trainer(scene, TrainConfig(steps=4, max_gaussians=50))
    spacing = gaussian_spacing(trainer.model, scene.train, usual_budget_for(scene, 4))
    assert spacing > POSITION_RATE_SPACING
    assert trainer.learning_rates == trainer.config.learning_rates.at_spacing(spacing)
    assert trainer.optimizer.rates == trainer.learning_rates


@pytest.mark.parametrize(("share", "factor"), [(0.1, 1), (1, 1), (1.5, 1.5), (4, 4)])
def test_positions_alone_learn_faster_where_gaussians_are_far_apart(share, factor):
    rates = LearningRates(positions=(0.5, 0.25))
    changed = rates.at_spacing(share * POSITION_RATE_SPACING)
    assert changed.positions == pytest.approx((factor * 0.5, factor * 0.25))
    assert dataclasses.replace(changed, positions=rates.positions) == rates

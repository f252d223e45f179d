from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from exposures import random_map
from hypothesis import given
from hypothesis import strategies as st
from scenes import ball_points, ball_scene, small_model

from hyrfpack.choices import CONSISTENT_EXPOSURE
from hyrfpack.model.exposure import MAX_CENTERS, ExposureMap, apply_exposure_gains, clamp_colors
from hyrfpack.model.gaussians import Gaussians
from hyrfpack.render import RenderSettings, render_view

RANDOM_SEEDS = st.integers(0, 2**32 - 1)


def normalize(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def random_viewpoints(seed: int, count: int = 50) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.normal(size=(count, 3)), normalize(rng.normal(size=(count, 3)))


@given(RANDOM_SEEDS)
def test_gains_follow_the_documented_sum(seed):
    exposure = random_map(seed)
    positions, directions = random_viewpoints(seed)
    least, largest = exposure.box.astype(float)
    for position, direction in zip(positions[:5], directions[:5], strict=True):
        expected = exposure.mean.astype(float)
        for x, f, w in zip(exposure.positions, exposure.directions, exposure.weights, strict=True):
            center = least + x / 255 * (largest - least)
            apart = np.sum((np.minimum(np.maximum(position, least), largest) - center) ** 2) / exposure.lengths[0] ** 2
            apart += np.sum((direction - f / 127) ** 2) / float(exposure.lengths[1]) ** 2
            expected = expected + w * exposure.steps.astype(float) / (1 + apart)
        expected = np.minimum(np.maximum(expected, exposure.limits[0]), exposure.limits[1])
        np.testing.assert_allclose(exposure.predict_log_gains(position, direction), expected, rtol=1e-5, atol=1e-6)


@given(RANDOM_SEEDS)
def test_exposure_changes_no_faster_than_its_bound(seed):
    exposure = random_map(seed)
    per_unit, per_radian = exposure.slope_bounds
    positions, directions = random_viewpoints(seed)
    rng = np.random.default_rng(seed)
    moved = positions + rng.normal(size=positions.shape) * 10.0 ** rng.uniform(-5, 1, (len(positions), 1))
    turned = normalize(directions + rng.normal(size=positions.shape) * 10.0 ** rng.uniform(-5, 0, (len(positions), 1)))
    here = exposure.predict_log_gains(positions, directions)

    change = np.abs(exposure.predict_log_gains(moved, directions) - here).max(1)
    assert (change <= per_unit * np.linalg.norm(moved - positions, axis=1) + 1e-9).all()
    change = np.abs(exposure.predict_log_gains(positions, turned) - here).max(1)
    angle = 2 * np.arcsin(np.minimum(np.linalg.norm(turned - directions, axis=1) / 2, 1))
    assert (change <= per_radian * angle + 1e-9).all()


@given(RANDOM_SEEDS)
def test_far_from_the_cameras_the_exposure_is_that_of_the_nearest_viewpoint(seed):
    exposure = random_map(seed)
    positions, directions = random_viewpoints(seed)
    nearest = np.clip(positions * 1e6, *exposure.box.astype(float))
    np.testing.assert_allclose(
        exposure.predict_log_gains(positions * 1e6, directions),
        exposure.predict_log_gains(nearest, directions),
        atol=1e-9,
    )


@pytest.mark.parametrize(
    ("field", "values"),
    [
        ("box", np.array([[0, 0, 1], [1, 1, 0]], np.float32)),
        ("lengths", np.array([0, 1], np.float32)),
        ("lengths", np.array([1, np.nan], np.float32)),
        ("limits", np.array([[0, 0, 9], [1, 1, 10]], np.float32)),
        ("limits", np.array([[1, 1, 1], [0, 0, 0]], np.float32)),
        ("mean", np.full(3, np.inf, np.float32)),
        ("mean", np.zeros(3)),
        ("weights", np.zeros((2, 3), np.int16)),
    ],
)
def test_numbers_out_of_range_are_rejected(field, values):
    with pytest.raises(ValueError, match="exposure map"):
        dataclasses.replace(random_map(0, centers=5), **{field: values})


def test_too_many_centers_are_rejected():
    with pytest.raises(ValueError, match=str(MAX_CENTERS)):
        random_map(0, centers=MAX_CENTERS + 1)


def constant_map(log_gains: list[float]) -> ExposureMap:
    gains = np.array(log_gains, np.float32)
    return dataclasses.replace(
        random_map(0, centers=0), mean=gains, limits=np.stack((gains, gains)), box=np.zeros((2, 3), np.float32)
    )


def test_render_applies_the_map_unless_one_exposure_is_requested():
    model, camera = small_model(ball_points(50)[0]), ball_scene().train[0].camera
    plain = render_view(model, camera).rgb
    model.exposure = constant_map([0.5, 0.0, -0.25])

    gains = torch.tensor([0.5, 0.0, -0.25]).exp()
    torch.testing.assert_close(render_view(model, camera).rgb, apply_exposure_gains(plain, gains))
    torch.testing.assert_close(
        render_view(model, camera, RenderSettings(exposure=CONSISTENT_EXPOSURE)).rgb, plain, rtol=0, atol=0
    )


def test_colours_above_one_are_white_at_any_exposure():
    model, camera = small_model(ball_points(50)[0], opacity_logits=4.0), ball_scene().train[0].camera
    residuals = torch.zeros(len(model), 3)
    residuals[:] = 10.0
    gaussians = model.gaussians
    parameters = {name: getattr(gaussians, name) for name in Gaussians.PARAMETER_NAMES}
    config = dataclasses.replace(model.config, residual_degree=0)
    bright = model.with_gaussians(
        Gaussians(**parameters, shape_residuals=torch.zeros(len(model), 5), color_residuals=residuals), config
    )
    plain = render_view(bright, camera).rgb
    bright.exposure = constant_map([-1.0, -1.0, -1.0])
    exposed = render_view(bright, camera).rgb
    assert plain.max() > 2 and (plain >= 1).float().mean() > 0.01
    assert bool((exposed[plain >= 1] == 1).all()) and bool(((exposed >= 0) & (exposed <= 1)).all())


def test_colours_above_one_are_clamped_with_a_gradient_that_darkens_them():
    image = torch.tensor([-0.2, 0.0, 0.4, 1.0, 1.5], requires_grad=True)
    clamped = clamp_colors(image)
    torch.testing.assert_close(clamped.detach(), torch.tensor([0.0, 0.0, 0.4, 1.0, 1.0]), rtol=0, atol=1e-7)
    clamped.sum().backward()
    assert image.grad is not None and image.grad.tolist() == [1.0] * 5


def test_render_differentiates_through_the_map():
    model, camera = small_model(ball_points(50)[0]).requires_grad_(), ball_scene().train[0].camera
    model.exposure = constant_map([1.0, 1.0, 1.0])
    render_view(model, camera).rgb.sum().backward()
    grad = model.gaussians.color_logits.grad
    assert grad is not None and grad.isfinite().all() and grad.abs().sum() > 0


def test_an_unknown_exposure_is_rejected():
    with pytest.raises(ValueError, match="as-photographed"):
        RenderSettings(exposure="bright")


def test_a_subset_of_a_model_keeps_its_exposure_map():
    model = small_model(ball_points(50)[0])
    model.exposure = random_map(1)
    assert model.subset(torch.arange(3)).exposure is model.exposure

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from property_tests import examples
from scenes import camera_at, ring

from hyrfpack.model.exposure import MAX_CENTERS, inverse_quadratic_kernel
from hyrfpack.train.exposure_map import (
    MAX_SLOPE_PER_DEGREE,
    MAX_SLOPE_PER_RADIUS,
    choose_centers,
    fit_exposure_map,
    leave_one_out_error,
)


def poses_of(cameras) -> list[np.ndarray]:
    return [camera.camera_from_world for camera in cameras]


def predict_log_gains(cameras, fit) -> np.ndarray:
    return np.array([np.log(fit.map.predict_gains(camera.camera_from_world)) for camera in cameras])


def one_sided_log_gains(cameras) -> np.ndarray:
    """Return log gains that are larger on one side of a ring."""
    return np.array([np.array([0.5, 0.45, 0.4]) * np.sin(np.arctan2(*c.position[:2])) for c in cameras])


def test_gains_that_vary_over_a_ring_are_predicted_between_its_cameras():
    cameras, between = ring(40), ring(80)[1::2]
    fit = fit_exposure_map(poses_of(cameras), one_sided_log_gains(cameras))

    assert fit.leave_one_out_error < 0.02
    np.testing.assert_allclose(predict_log_gains(cameras, fit), one_sided_log_gains(cameras), atol=0.03)
    np.testing.assert_allclose(predict_log_gains(between, fit), one_sided_log_gains(between), atol=0.05)


def test_two_flights_keep_their_different_exposure():
    low, high = ring(20, radius=3.0, elevation=1.0), ring(20, radius=3.0, elevation=4.0)
    gains = np.repeat([[-0.6] * 3, [0.6] * 3], 20, 0)
    fit = fit_exposure_map(poses_of(low + high), gains)
    np.testing.assert_allclose(predict_log_gains(low + high, fit), gains, atol=0.1)


def test_exposures_that_viewpoints_do_not_explain_become_their_mean():
    cameras = ring(40)
    gains = np.where(np.random.default_rng(3).random((40, 1)) < 0.5, 0.7, -0.7) * np.ones(3)
    fit = fit_exposure_map(poses_of(cameras), gains)
    predicted = predict_log_gains(cameras, fit)
    assert np.abs(predicted - gains.mean(0)).max() < 0.35 and fit.leave_one_out_error > 0.6


@pytest.mark.parametrize("place", [(0.0, 0.0, 0.0), (0.3, 0.2, 0.1), (10.0, 10.0, 10.0)])
def test_exposures_of_a_camera_that_turns_on_the_spot_are_predicted(place):
    angles = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    targets = np.array(place) + np.stack([np.cos(angles), np.sin(angles), np.zeros(40)], 1)
    cameras = [camera_at(place, target=target) for target in targets]
    gains = 0.5 * np.sin(angles)[:, None] * np.ones(3)
    fit = fit_exposure_map(poses_of(cameras), gains)
    np.testing.assert_allclose(predict_log_gains(cameras, fit), gains, atol=0.05)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_a_map_can_be_fitted_to_few_photos(count):
    cameras = ring(count)
    gains = np.linspace(-0.2, 0.3, 3 * count).reshape(count, 3)
    predicted = predict_log_gains(cameras, fit_exposure_map(poses_of(cameras), gains))
    assert np.isfinite(predicted).all()
    assert (predicted >= gains.min(0) - 1e-6).all() and (predicted <= gains.max(0) + 1e-6).all()


def test_a_map_can_be_fitted_to_photos_from_one_place():
    camera = camera_at((2, 0, 1))
    gains = np.array([[0.1] * 3, [0.2] * 3, [0.3] * 3])
    np.testing.assert_allclose(
        predict_log_gains([camera], fit_exposure_map([camera.camera_from_world] * 3, gains)), 0.2
    )


def test_equal_gains_are_predicted_exactly():
    cameras = ring(12)
    predicted = predict_log_gains(cameras, fit_exposure_map(poses_of(cameras), np.full((12, 3), 0.25)))
    np.testing.assert_allclose(predicted, 0.25, atol=1e-6)


@examples(30)
@given(st.integers(0, 2**32 - 1), st.integers(1, 90))
def test_a_map_never_changes_faster_than_allowed_nor_leaves_the_range_of_the_photos(seed, count):
    rng = np.random.default_rng(seed)
    cameras = [camera_at(rng.normal(size=3) * 3, target=rng.normal(size=3) * 10 + 20) for _ in range(count)]
    gains = rng.normal(size=(count, 3)) * rng.uniform(0, 2)
    exposure = fit_exposure_map(poses_of(cameras), gains).map

    positions = np.array([camera.position for camera in cameras])
    radius = np.sqrt(np.square(positions - positions.mean(0)).sum(1).mean()) or 1.0
    per_unit, per_radian = exposure.slope_bounds
    assert per_unit * radius <= MAX_SLOPE_PER_RADIUS * 1.001
    assert np.radians(per_radian) <= MAX_SLOPE_PER_DEGREE * 1.001
    assert len(exposure.positions) <= MAX_CENTERS
    predicted = exposure.predict_log_gains(rng.normal(size=(100, 3)) * 10, rng.normal(size=(100, 3)))
    assert (predicted >= gains.min(0) - 1e-5).all() and (predicted <= gains.max(0) + 1e-5).all()


def test_the_leave_one_out_error_is_that_of_fits_without_each_photo():
    rng = np.random.default_rng(5)
    features, gains, ridge = rng.normal(size=(15, 6)), rng.normal(size=(15, 3)), 0.1
    factor = np.linalg.cholesky(inverse_quadratic_kernel(features, features) + 1e-12 * np.eye(15))

    errors = []
    for left in range(15):
        rest = np.delete(np.arange(15), left)
        design = np.column_stack((np.ones(14), factor[rest]))
        penalty = np.diag([0.0] + [ridge] * 15)
        solution = np.linalg.solve(design.T @ design + penalty, design.T @ gains[rest])
        errors.append(gains[left] - np.concatenate(([1.0], factor[left])) @ solution)
    assert leave_one_out_error(factor, gains, ridge) == pytest.approx(np.sqrt(np.square(errors).mean()))


def test_centres_reproduce_the_kernel_matrix():
    features = np.random.default_rng(1).normal(size=(50, 3))
    gram = inverse_quadratic_kernel(features, features)
    centers, factor, variances = choose_centers(features)
    assert (np.diff(variances) <= 1e-12).all()
    assert len(set(centers)) == len(centers) <= 50
    assert np.diag(gram - factor @ factor.T).max() < 0.01

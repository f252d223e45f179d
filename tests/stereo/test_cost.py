"""hyrfpack.stereo.cost: costs against a float64 reference, on random and hard cases."""

from __future__ import annotations

import numpy as np
import pytest
from textured_planes import camera_at

from hyrfpack.scene import Camera
from hyrfpack.stereo.cost import compute_cost_volume
from hyrfpack.stereo.cost_kernels import NOISE_VARIANCE, WINDOW_RADIUS

# Means of squares are rounded to 2^-24; in windows without texture they are divided by the noise alone.
MAX_ROUNDING_ERROR = 2**-24 / NOISE_VARIANCE


def window_means(values: np.ndarray) -> np.ndarray:
    means = np.empty_like(values)
    for y, x in np.ndindex(values.shape):
        top, left = max(0, y - WINDOW_RADIUS), max(0, x - WINDOW_RADIUS)
        means[y, x] = values[top : y + WINDOW_RADIUS + 1, left : x + WINDOW_RADIUS + 1].mean()
    return means


def reference_costs(camera: Camera, photo, others, inverses) -> np.ndarray:
    """Do what `compute_cost_volume` does in float64, through world coordinates; NaN where a point is near a border."""
    photo = photo.astype(np.float64)
    y, x = (np.mgrid[: camera.height, : camera.width] + 0.5).reshape(2, -1)
    mean = window_means(photo)
    variance = np.maximum(window_means(photo**2) - mean**2, 0)
    result = np.empty((*photo.shape, len(inverses)))
    for plane, inverse in enumerate(inverses):
        costs = []
        for other, grey in others:
            if inverse > 0:
                u, v, z = other.project(camera.unproject(x, y, np.full(len(x), 1 / inverse)))
            else:  # the directions of the pixels
                rays = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones(len(x))], 1)
                a, b, z = (rays @ camera.rotation @ other.rotation.T).T
                u, v = other.fx * a / z + other.cx, other.fy * b / z + other.cy
            height, width = grey.shape
            margins = np.stack([u - 0.5, width - 0.5 - u, v - 0.5, height - 0.5 - v]).min(0)
            seen = (z > 0) & (margins >= 0)
            i, j = np.clip(v - 0.5, 0, height - 1), np.clip(u - 0.5, 0, width - 1)
            top, left = i.astype(int), j.astype(int)
            bottom, right = np.minimum(top + 1, height - 1), np.minimum(left + 1, width - 1)
            g = grey.astype(np.float64)
            upper = (1 - (j - left)) * g[top, left] + (j - left) * g[top, right]
            lower = (1 - (j - left)) * g[bottom, left] + (j - left) * g[bottom, right]
            warped = ((1 - (i - top)) * upper + (i - top) * lower).reshape(photo.shape)
            m = window_means(warped)
            spread = np.maximum(window_means(warped**2) - m**2, 0)
            covariance = window_means(warped * photo) - m * mean
            correlation = covariance / np.sqrt((spread + NOISE_VARIANCE) * (variance + NOISE_VARIANCE))
            cost = np.where(seen.reshape(photo.shape), 1 - np.clip(correlation, 0, 1), np.inf)
            cost[(np.abs(margins) < 1e-6).reshape(photo.shape)] = np.nan
            costs.append(cost)
        ordered = np.sort(np.stack(costs), 0)
        count = np.isfinite(ordered).sum(0)
        used = (count + 1) // 2
        total = np.where(np.arange(len(costs))[:, None, None] < used, ordered, 0).sum(0)
        result[..., plane] = np.where(count > 0, total / np.maximum(used, 1), 1)
        result[np.isnan(np.stack(costs)).any(0), plane] = np.nan
    return result


def resized(camera: Camera, width: int, height: int) -> Camera:
    return Camera(width, height, camera.fx, camera.fy, width / 2, height / 2, camera.camera_from_world)


def other_camera(camera: Camera) -> Camera:
    """Return a camera of 21 x 19 pixels at the same place with another lens, rolled and pitched a little."""
    roll, pitch = 0.2, 0.1
    rolled = np.array([[np.cos(roll), -np.sin(roll), 0], [np.sin(roll), np.cos(roll), 0], [0, 0, 1]])
    pitched = np.array([[1, 0, 0], [0, np.cos(pitch), -np.sin(pitch)], [0, np.sin(pitch), np.cos(pitch)]])
    pose = camera.camera_from_world.copy()
    pose[:3] = rolled @ pitched @ pose[:3]
    return Camera(21, 19, 22.0, 17.0, 9.0, 11.0, pose)


CAMERAS_BY_CASE = {
    "beside": [camera_at(0.3), camera_at(-0.2, 0.1)],
    "ahead": [camera_at(0.0, 0.0, 0.8)],
    "turned": [camera_at(0.5, turn=-0.3), camera_at(-0.5, turn=0.3), camera_at(0.1), camera_at(0.0, 0.4)],
    "looking back": [camera_at(0.0, 0.0, 4.0, turn=np.pi), camera_at(0.2)],
    "looking away": [camera_at(0.0, turn=np.pi)],
    "same place": [camera_at(0.0)],
}


@pytest.mark.parametrize("size", [(23, 17), (7, 7), (6, 4), (3, 9), (1, 1)], ids=str)
@pytest.mark.parametrize("name", CAMERAS_BY_CASE)
def test_costs_are_those_of_the_reference(name, size):
    generator = np.random.default_rng(0)
    camera = resized(camera_at(0.0), *size)
    photo = generator.random((size[1], size[0]), np.float32)
    others = [(other_camera(other), generator.random((19, 21), np.float32)) for other in CAMERAS_BY_CASE[name]]
    inverses = np.array([0.0, 0.2, 0.9, 3.0])
    costs = compute_cost_volume(camera, photo, others, inverses)
    expected = reference_costs(camera, photo, others, inverses)
    assert costs.dtype == np.float32 and np.isfinite(costs).all()
    known = ~np.isnan(expected)
    assert known.mean() > 0.9
    np.testing.assert_allclose(costs[known], expected[known], atol=MAX_ROUNDING_ERROR)


def test_exposure_does_not_change_costs_much():
    generator = np.random.default_rng(1)
    photo, other = generator.random((2, 30, 40), np.float32)
    camera = resized(camera_at(0.0), 40, 30)
    usual = compute_cost_volume(camera, photo, [(resized(camera_at(0.2), 40, 30), other)], np.array([0.3]))
    darker = compute_cost_volume(camera, photo, [(resized(camera_at(0.2), 40, 30), 0.1 + 0.5 * other)], np.array([0.3]))
    assert np.abs(usual - darker).max() < 2e-3


@pytest.mark.parametrize("grey", [0.0, 0.3, 1.0])
def test_photos_without_texture_match_nowhere(grey):
    """Rounding of the windows' sums must not look like texture."""
    photo = np.full((20, 20), grey, np.float32)
    camera = resized(camera_at(0.0), 20, 20)
    costs = compute_cost_volume(camera, photo, [(resized(camera_at(0.1), 20, 20), photo)], np.linspace(0, 1, 5))
    assert costs.min() > 0.99

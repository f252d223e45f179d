"""Merged Gaussians have the moments of their mixture, and the chosen clusters are compact."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scenes import small_model
from scipy.spatial.transform import Rotation

from hyrfpack.lod.merge import Moments, fit_logits, merge_gaussians, merge_moments
from hyrfpack.lod.partition import cluster, partition
from tools.safety.make_golden import add_golden_residuals

pytestmark = pytest.mark.unit

POSITIONS = np.random.default_rng(5).uniform(-0.8, 0.8, (50, 3))


def random_moments(count: int, rng: np.random.Generator) -> Moments:
    roots = 0.1 * rng.normal(size=(count, 3, 3))
    covariances = roots @ roots.transpose(0, 2, 1) + 1e-3 * np.eye(3)
    return Moments(
        rng.normal(size=(count, 3)), covariances, rng.uniform(0.01, 0.1, count), rng.uniform(size=(count, 3))
    )


def test_a_merged_gaussian_has_the_moments_of_samples_of_its_mixture():
    rng = np.random.default_rng(3)
    parts = random_moments(4, rng)
    weights = parts.opacities * np.cbrt(np.linalg.det(parts.covariances))
    counts = rng.multinomial(400_000, weights / weights.sum())
    samples = np.concatenate(
        [rng.multivariate_normal(m, c, n) for m, c, n in zip(parts.means, parts.covariances, counts, strict=True)]
    )

    merged = merge_moments(parts, np.zeros(4, np.int64), 1)

    np.testing.assert_allclose(merged.means[0], samples.mean(axis=0), atol=0.01)
    np.testing.assert_allclose(merged.covariances[0], np.cov(samples.T), atol=0.02)


def test_merging_keeps_opacity_times_area():
    parts = random_moments(6, np.random.default_rng(0))
    labels = np.array([0, 0, 1, 1, 2, 2])

    merged = merge_moments(parts, labels, 3)

    np.testing.assert_allclose(
        merged.opacities * merged.areas, np.bincount(labels, parts.opacities * parts.areas), rtol=1e-12
    )


def test_merging_copies_of_one_gaussian_gives_it_back():
    part = random_moments(1, np.random.default_rng(1))
    three = Moments(*(np.repeat(values, 3, axis=0) for values in vars(part).values()))

    merged = merge_moments(three, np.zeros(3, np.int64), 1)

    np.testing.assert_allclose(merged.means, part.means)
    np.testing.assert_allclose(merged.covariances, part.covariances)
    np.testing.assert_allclose(merged.opacities, 3 * part.opacities)


def test_a_cluster_without_opacity_becomes_an_invisible_gaussian_at_its_mean():
    parts = random_moments(4, np.random.default_rng(2))
    parts.opacities[:2] = 0

    merged = merge_moments(parts, np.array([0, 0, 1, 1]), 2)

    np.testing.assert_allclose(merged.means[0], parts.means[:2].mean(axis=0))
    np.testing.assert_allclose(merged.colors[0], parts.colors[:2].mean(axis=0))
    assert merged.opacities[0] == 0 and merged.opacities[1] > 0 and np.isfinite(merged.covariances).all()


def test_invisible_gaussians_merge_to_finite_ones_that_are_invisible():
    model = small_model(POSITIONS, fields=0.5, opacity_logits=-300.0).requires_grad_(False)

    merged = model.with_gaussians(merge_gaussians(model, model.decode_geometry(), [torch.zeros(3)], 12))

    assert all(torch.isfinite(parameter).all() for parameter in merged.parameters())
    assert merged.decode_geometry().opacities.max() < 1e-5  # the logit of 0 is finite


def test_fitted_logits_give_the_volume_the_opacity_and_the_colour_of_a_view():
    model = small_model(POSITIONS, fields=0.5)
    geometry = model.decode_geometry()
    viewpoint = torch.tensor([0.3, -2.0, 0.4])
    covariances = 1.3**2 * np.stack([np.diag(row) for row in geometry.scales.detach().double().numpy() ** 2])
    colors = np.random.default_rng(0).uniform(0.2, 0.8, (50, 3))
    target = Moments(model.gaussians.positions.detach().double().numpy(), covariances, np.full(50, 0.4), colors)

    fitted = model.with_gaussians(fit_logits(model, target, [viewpoint]))

    decoded = fitted.decode_geometry()
    volumes = decoded.scales.detach().double().prod(dim=1).numpy()
    np.testing.assert_allclose(volumes, np.sqrt(np.linalg.det(covariances)), rtol=1e-3)
    np.testing.assert_allclose(decoded.opacities.detach().numpy(), 0.4, rtol=1e-3)
    np.testing.assert_allclose(fitted.decode_colors(viewpoint).detach().numpy(), colors, atol=1e-4)


def test_residuals_give_merged_gaussians_the_whole_covariance_and_the_colour_of_a_view():
    model = add_golden_residuals(small_model(POSITIONS, fields=0.5), 1).requires_grad_(False)
    rng, viewpoint = np.random.default_rng(0), torch.tensor([0.3, -2.0, 0.4])
    # Standard deviations up to 0.2 lie below the largest that a model can have.
    axes = Rotation.random(50, rng).as_matrix() * rng.uniform(0.01, 0.2, (50, 1, 3))
    covariances = axes @ axes.transpose(0, 2, 1)
    seen, residuals = rng.uniform(0.4, 0.6, (50, 3)), rng.uniform(-0.1, 0.1, (50, 12))
    target = Moments(POSITIONS, covariances, np.full(50, 0.4), np.concatenate((seen, residuals), axis=1))

    fitted = model.with_gaussians(fit_logits(model, target, [viewpoint])).requires_grad_(False)

    decoded = fitted.decode_geometry()
    turns = Rotation.from_quat(decoded.quats.double().numpy(), scalar_first=True).as_matrix()
    found = turns * decoded.scales.double().numpy()[:, None, :]
    np.testing.assert_allclose(found @ found.transpose(0, 2, 1), covariances, atol=1e-6)
    np.testing.assert_allclose(decoded.opacities.numpy(), 0.4, rtol=1e-3)
    np.testing.assert_allclose(fitted.decode_colors(viewpoint).numpy(), seen, atol=1e-4)
    np.testing.assert_array_equal(fitted.gaussians.color_residuals.numpy(), residuals.astype(np.float32))


def test_merging_gives_the_asked_number_within_the_box_of_the_model():
    model = small_model(POSITIONS, fields=0.5).requires_grad_(False)

    merged = merge_gaussians(model, model.decode_geometry(), [torch.zeros(3)], 12)

    assert len(merged) == 12
    positions = model.gaussians.positions
    assert (merged.positions >= positions.amin(0) - 1e-6).all() and (merged.positions <= positions.amax(0) + 1e-6).all()


def test_a_partition_covers_each_point_once_in_groups_of_bounded_size():
    points = np.random.default_rng(0).normal(size=(1000, 3))

    groups = partition(points, 130)

    assert sorted(np.concatenate(groups).tolist()) == list(range(1000))
    assert max(map(len, groups)) <= 130 and min(map(len, groups)) >= 65


@pytest.mark.parametrize("count", [1, 7, 100])
def test_clusters_are_not_empty_and_of_almost_equal_size(count):
    labels = cluster(np.random.default_rng(0).normal(size=(100, 4)), count)

    sizes = np.bincount(labels, minlength=count)
    assert len(sizes) == count and sizes.min() >= 1 and sizes.max() <= -(-100 // count) + 1


def test_separate_groups_of_points_are_not_mixed():
    points = np.concatenate([np.random.default_rng(0).normal(size=(8, 3)), 100 + np.zeros((8, 3))])

    labels = cluster(points, 2)

    assert len(set(labels[:8])) == len(set(labels[8:])) == 1

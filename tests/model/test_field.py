from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.special import lpmv

from hyrfpack.model.field import Field
from hyrfpack.model.hash_grid import HashGridConfig
from hyrfpack.ops.shade import DIRECTION_FEATURES, encode_directions, spherical_harmonics

SMALL_GRID = HashGridConfig(log2_table_size=7, levels=3, base=3, finest=12)


def sphere_quadrature() -> tuple[np.ndarray, np.ndarray]:
    """Return directions and weights that integrate polynomials up to degree 15 exactly over the sphere."""
    heights, weights = np.polynomial.legendre.leggauss(8)
    angles = 2 * np.pi * np.arange(16) / 16
    heights, angles = (grid.ravel() for grid in np.meshgrid(heights, angles, indexing="ij"))
    ring = np.sqrt(1 - heights**2)
    directions = np.stack((ring * np.cos(angles), ring * np.sin(angles), heights), axis=1)
    return directions, np.repeat(weights, 16) * 2 * np.pi / 16


def legendre_harmonic(band: int, order: int, directions: np.ndarray) -> np.ndarray:
    """Return a real spherical harmonic from associated Legendre functions, without the Condon-Shortley phase."""
    x, y, z = directions.T
    m = abs(order)
    norm = math.sqrt((2 * band + 1) / (4 * math.pi) * math.factorial(band - m) / math.factorial(band + m))
    around = np.arctan2(y, x)
    turn = 1.0 if order == 0 else math.sqrt(2) * (np.cos(m * around) if order > 0 else np.sin(m * around))
    return (-1) ** m * norm * lpmv(m, band, z) * turn


def test_spherical_harmonics_are_orthonormal():
    directions, weights = sphere_quadrature()
    values = spherical_harmonics(torch.from_numpy(directions)).numpy()
    np.testing.assert_allclose(values.T @ (values * weights[:, None]), np.eye(9), atol=1e-12)


def test_spherical_harmonics_are_ordered_by_band_and_order():
    directions, _ = sphere_quadrature()
    expected = [legendre_harmonic(l, m, directions) for l in range(3) for m in range(-l, l + 1)]  # noqa: E741
    values = spherical_harmonics(torch.from_numpy(directions)).numpy()
    np.testing.assert_allclose(values, np.stack(expected, axis=1), atol=1e-12)


def test_frequency_encoding_is_sines_and_cosines_of_four_octaves():
    direction = np.array([0.48, -0.6, 0.64])
    expected = [f(math.pi * 2**k * c) for f in (math.sin, math.cos) for k in range(4) for c in direction]
    encoded = encode_directions(torch.from_numpy(direction)[None], "frequency")
    np.testing.assert_allclose(encoded[0].numpy(), expected, atol=1e-14)


@pytest.mark.parametrize("encoding", ["sh", "frequency"])
def test_encoded_directions_have_the_declared_width(encoding):
    directions = torch.nn.functional.normalize(torch.randn(5, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    assert encode_directions(directions, encoding).shape == (5, DIRECTION_FEATURES[encoding])


def test_an_untrained_field_is_near_zero():
    field = Field(SMALL_GRID, outputs=8, hidden=64, generator=torch.Generator().manual_seed(0))
    coords = torch.rand(500, 3, generator=torch.Generator().manual_seed(1))
    assert field(coords).abs().max() < 1e-2


def test_field_weights_fill_the_xavier_range():
    field = Field(SMALL_GRID, outputs=8, hidden=64, extra_inputs=9, generator=torch.Generator().manual_seed(0))
    assert [tuple(w.shape) for w in field.weights] == [(64, 15), (64, 64), (8, 64)]
    for weight in field.weights:
        bound = math.sqrt(6 / sum(weight.shape))
        assert 0.95 * bound < weight.abs().max() <= bound
        assert abs(weight.std() - bound / math.sqrt(3)) < 0.1 * bound


# The squared length of the inputs is 9 / (4 pi) or 24 / 2. Xavier layers with ReLUs, which halve it, give
# |x|^2 * 2 / (inputs + 64) / 2 * 64 * 2 / 128 / 2 * 64 * 2 / 67.
@pytest.mark.parametrize(("encoding", "deviation"), [("sh", 0.0807), ("frequency", 0.309)])
def test_the_output_of_an_untrained_field_scales_with_its_direction_inputs(encoding, deviation):
    directions = torch.nn.functional.normalize(torch.randn(500, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    extra = encode_directions(directions, encoding)
    squares = []
    for seed in range(40):
        generator = torch.Generator().manual_seed(seed)
        field = Field(HashGridConfig(8), outputs=3, hidden=64, extra_inputs=extra.shape[1], generator=generator)
        with torch.no_grad():
            squares.append(float(field(torch.full((500, 3), 0.5), extra).square().mean()))
    assert math.sqrt(np.mean(squares)) == pytest.approx(deviation, rel=0.2)


def test_field_is_the_same_for_the_same_seed_only():
    def made(seed: int) -> Field:
        return Field(SMALL_GRID, outputs=3, hidden=16, generator=torch.Generator().manual_seed(seed))

    for (_, a), (_, b) in zip(made(3).named_parameters(), made(3).named_parameters(), strict=True):
        assert torch.equal(a, b)
    assert not torch.equal(made(3).grid.table, made(4).grid.table)


@pytest.mark.parametrize(
    "settings",
    [
        {"log2_table_size": 3},
        {"log2_table_size": 25},
        {"log2_table_size": 8, "levels": 0},
        {"log2_table_size": 8, "levels": 33},
        {"log2_table_size": 8, "base": 1},
        {"log2_table_size": 8, "base": 64, "finest": 32},
        {"log2_table_size": 8, "finest": 65537},
    ],
)
def test_hash_grid_rejects_impossible_shapes(settings):
    with pytest.raises(ValueError):
        HashGridConfig(**settings)


def test_hash_grid_rows_are_dense_until_the_table_is_full():
    grid = HashGridConfig(log2_table_size=10, levels=3, base=4, finest=64)  # 4, 16, 64 vertices
    assert grid.resolutions == (4, 16, 64)
    assert grid.offsets == (0, 64, 64 + 1024, 64 + 2048) and grid.rows == 2112

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from scipy.special import sph_harm_y

from hyrfpack.ops.harmonics import harmonics_basis, num_sh_bases
from hyrfpack.splats.harmonics import SH_C0, compute_harmonics_rotation

RANDOM_GENERATOR = np.random.default_rng(0)


def random_directions(count: int) -> np.ndarray:
    rows = RANDOM_GENERATOR.normal(size=(count, 3))
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def evaluate_basis(directions: np.ndarray, degree: int = 3) -> np.ndarray:
    return harmonics_basis(torch.from_numpy(directions), degree).numpy()


def test_the_basis_equals_the_real_and_imaginary_parts_of_scipys_harmonics():
    d = random_directions(50)
    polar, azimuth = np.arccos(d[:, 2]), np.arctan2(d[:, 1], d[:, 0])
    columns = []
    for band in range(4):
        for order in range(-band, band + 1):
            value = sph_harm_y(band, abs(order), polar, azimuth)
            columns.append(value.real if order == 0 else np.sqrt(2) * (value.imag if order < 0 else value.real))
    assert np.allclose(evaluate_basis(d), np.stack(columns, axis=1), atol=1e-12)


def test_the_basis_is_orthonormal_on_the_sphere():
    heights, weights = np.polynomial.legendre.leggauss(8)  # with 16 azimuths, exact for products of bands up to 3
    angles = np.arange(16) * np.pi / 8
    z, a = map(np.ravel, np.meshgrid(heights, angles, indexing="ij"))
    rows = evaluate_basis(np.stack((np.sqrt(1 - z**2) * np.cos(a), np.sqrt(1 - z**2) * np.sin(a), z), axis=1))
    gram = rows.T @ (np.repeat(weights, 16)[:, None] * np.pi / 8 * rows)
    assert np.allclose(gram, np.eye(16), atol=1e-12)


@pytest.mark.parametrize("degree", range(4))
def test_the_basis_of_a_lower_degree_is_the_first_columns(degree):
    d = random_directions(5)
    assert np.array_equal(evaluate_basis(d, degree), evaluate_basis(d)[:, : num_sh_bases(degree)])
    assert np.allclose(evaluate_basis(d, 0), SH_C0)


@pytest.mark.parametrize("degree", range(4))
def test_rotated_coefficients_give_the_rotated_function(degree):
    turn, d = Rotation.random(rng=1).as_matrix(), random_directions(40)
    coefficients = RANDOM_GENERATOR.normal(size=num_sh_bases(degree))
    turned = compute_harmonics_rotation(turn, degree) @ coefficients
    assert np.allclose(evaluate_basis(d, degree) @ turned, evaluate_basis(d @ turn, degree) @ coefficients, atol=1e-12)


def test_rotations_of_coefficients_compose_and_keep_norms():
    first, second = Rotation.random(2, rng=2).as_matrix()
    both = compute_harmonics_rotation(second, 3) @ compute_harmonics_rotation(first, 3)
    assert np.allclose(both, compute_harmonics_rotation(second @ first, 3), atol=1e-12)
    assert np.allclose(both @ both.T, np.eye(16), atol=1e-12)


def test_a_half_turn_about_x_only_changes_signs():
    signs = compute_harmonics_rotation(np.diag([1.0, -1.0, -1.0]), 3)
    assert np.allclose(np.abs(signs), np.eye(16), atol=1e-12)
    assert np.diagonal(signs)[:4].round().tolist() == [1, -1, -1, 1]  # the signs of 1, -y, z, -x

"""Quaternions and matrices agree with those of SciPy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hyrfpack.rotations import multiply_quats, quaternion_from_matrix, rotation_matrix


def random_turns(count: int) -> Rotation:
    return Rotation.random(count, random_state=3)


def wxyz(turn: Rotation) -> np.ndarray:
    return np.roll(turn.as_quat(), 1, axis=-1)


@pytest.mark.parametrize("turn", [*random_turns(20), Rotation.from_rotvec([np.pi, 0, 0]), Rotation.identity()])
def test_a_quaternion_and_its_matrix_are_those_of_scipy(turn):
    quat = wxyz(turn)

    assert np.allclose(rotation_matrix(quat * (1 + 9e-7)), turn.as_matrix(), rtol=0, atol=1e-15)
    assert abs(quaternion_from_matrix(turn.as_matrix()) @ quat) == pytest.approx(1, abs=1e-15)


def test_a_product_of_quaternions_is_that_of_their_rotations():
    first, second = random_turns(2)
    product = multiply_quats(wxyz(first), wxyz(second)[None])[0]

    assert np.allclose(rotation_matrix(product), (first * second).as_matrix(), rtol=0, atol=1e-14)


@pytest.mark.parametrize(
    "quat", [(1, 0, 0), (0, 0, 0, 0), (1e200, 1e200, 0, 0), (float("inf"), 0, 0, 0), (1.1, 0, 0, 0)]
)
def test_other_numbers_are_refused(quat):
    with pytest.raises(ValueError, match="quaternion of unit length"):
        rotation_matrix(quat)

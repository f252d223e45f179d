"""Residuals change shapes and colours as docs/reference/format.md says, and a rotation of the scene keeps them."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scenes import small_model
from scipy.spatial.transform import Rotation

from hyrfpack.model.residuals import add_color_residuals, add_shape_residuals, count_color_residuals
from tools.safety import minimal_reader
from tools.safety.make_golden import add_golden_residuals

FLOAT32_ROUNDING = {"rtol": 1e-6, "atol": 1e-6}


def random_tensor(*shape: int, seed: int) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def test_shape_residuals_give_the_numbers_of_the_specification():
    raw, residuals = random_tensor(50, 8, seed=0), random_tensor(50, 5, seed=1)
    expected = [minimal_reader.correct_shape(*pair) for pair in zip(raw.tolist(), residuals.tolist(), strict=True)]
    np.testing.assert_allclose(add_shape_residuals(raw, residuals), expected, **FLOAT32_ROUNDING)


def test_the_rotation_of_a_shape_residual_comes_before_that_of_the_field():
    raw, residuals = random_tensor(50, 8, seed=2).double(), random_tensor(50, 5, seed=3).double()
    outputs = add_shape_residuals(raw, residuals).numpy()

    def rotation(quats: np.ndarray) -> Rotation:
        return Rotation.from_quat(np.roll(quats, -1, axis=1))  # scipy puts w last

    one = np.array([1.0, 0.0, 0.0, 0.0])
    own = np.concatenate((np.ones((50, 1)), residuals[:, 2:]), axis=1)
    expected = rotation(raw[:, 4:].numpy() + one) * rotation(own)
    np.testing.assert_allclose(rotation(outputs[:, 4:] + one).as_matrix(), expected.as_matrix(), atol=1e-12)


@pytest.mark.parametrize("degree", range(4))
def test_color_residuals_give_the_numbers_of_the_specification(degree: int):
    colors = torch.rand(40, 3, generator=torch.Generator().manual_seed(4))
    residuals = random_tensor(40, count_color_residuals(degree), seed=5)
    directions = torch.nn.functional.normalize(random_tensor(40, 3, seed=6), dim=1)
    expected = [
        minimal_reader.correct_color(*rows)
        for rows in zip(colors.tolist(), residuals.numpy(), directions.tolist(), strict=True)
    ]
    found = add_color_residuals(colors, residuals, directions)
    np.testing.assert_allclose(found, expected, **FLOAT32_ROUNDING)
    assert (found == 0).any() and (found > 1).any()  # the lower bound is 0, and there is no upper one


def test_residuals_of_zero_change_nothing():
    model = small_model(np.random.default_rng(0).normal(size=(30, 3)), fields=1.0)
    with_residuals = add_golden_residuals(model, 1)
    for residuals in (with_residuals.gaussians.shape_residuals, with_residuals.gaussians.color_residuals):
        residuals.zero_()
    eye = torch.tensor([0.3, -2.0, 1.0])
    with torch.no_grad():
        before, after = vars(model.decode_geometry()), vars(with_residuals.decode_geometry())
        for name, values in before.items():
            torch.testing.assert_close(after[name], values)
        torch.testing.assert_close(with_residuals.decode_colors(eye), model.decode_colors(eye))

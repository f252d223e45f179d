from __future__ import annotations

import numpy as np
import pytest
import torch

from hyrfpack.model.gaussians import LOGIT_LIMIT, Gaussians, logit


def test_logit_inverts_the_sigmoid():
    values = torch.linspace(-11.5, 11.5, 101, dtype=torch.float64)
    np.testing.assert_allclose(logit(torch.sigmoid(values)).numpy(), values.numpy(), atol=1e-5)


def test_logit_clamps_zero_and_one_to_the_limit():
    values = logit(torch.tensor([-1.0, 0.0, 1e-30, 0.5, 1.0, 2.0]))
    torch.testing.assert_close(values, LOGIT_LIMIT * torch.tensor([-1.0, -1, -1, 0, 1, 1]))


@pytest.mark.parametrize("wrong", range(4))
def test_gaussians_reject_rows_that_do_not_match(wrong):
    shapes = [(5, 3), (5, 3), (5, 1), (5, 1)]
    shapes[wrong] = (5, 2)
    with pytest.raises(ValueError, match=Gaussians.PARAMETER_NAMES[wrong]):
        Gaussians(*(torch.zeros(shape) for shape in shapes))

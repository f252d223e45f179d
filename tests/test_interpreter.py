"""The interpreter of the tests refuses arguments that a launch on a GPU would refuse."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from ops.device import IS_INTERPRETED, needs_triton

from hyrfpack.ops.contraction import gpu
from hyrfpack.ops.contraction.gpu import contract

pytestmark = [needs_triton, pytest.mark.skipif(not IS_INTERPRETED, reason="kernels run on the GPU that is there")]


@pytest.mark.parametrize("number", [np.int64(2), np.float32(2.0)])
def test_numbers_of_numpy_are_refused_as_arguments_of_a_launch(number):
    with pytest.raises(TypeError, match="failed to specialize argument"):
        contract(torch.zeros(2, 3), (number, 1.0, 1.0))


def test_numbers_of_python_are_taken():
    assert gpu.contract(torch.zeros(2, 3), (2.0, 1.0, 1.0)).eq(0.5).all()


def test_new_memory_of_a_gpu_operation_is_nan_and_that_of_others_is_not_touched():
    from hyrfpack.ops.rasterize import gpu

    rows = gpu._empty_rows(3, torch.device("cpu"))
    assert rows.view(torch.float32).isnan().all()
    assert torch.empty(0).dtype == torch.float32 and torch.empty(2, 3).shape == (2, 3)

from __future__ import annotations

import math

import pytest
import torch

from hyrfpack.errors import HyrfError
from hyrfpack.measure.error import Error, largest_error, measure_error, measure_relative_error


def test_difference_gives_the_maximum_and_the_root_mean_square():
    off = measure_error(torch.tensor([1.0, 2.0, 7.0]), torch.tensor([1.0, -1.0, 3.0]), "numbers")
    assert off.max == 4 and off.rms == pytest.approx(math.sqrt((0 + 9 + 16) / 3))


def test_relative_difference_is_over_the_reference_s_size():
    reference = torch.tensor([6.0, 8.0, 0.0])
    off = measure_relative_error(reference + torch.tensor([0.0, 0.0, 4.0]), reference, "numbers")
    assert off.max == pytest.approx(4 / 8) and off.rms == pytest.approx(4 / 10)


def test_relative_difference_from_all_zeros_is_absolute():
    off = measure_relative_error(torch.tensor([3.0, 4.0]), torch.zeros(2), "numbers")
    assert off.max == 4 and off.rms == pytest.approx(math.sqrt(12.5))


@pytest.mark.parametrize("wrong", [math.nan, math.inf])
@pytest.mark.parametrize("side", [0, 1])
def test_a_result_that_is_not_finite_is_rejected_by_name(wrong, side):
    tensors = [torch.zeros(3), torch.zeros(3)]
    tensors[side][1] = wrong
    with pytest.raises(HyrfError, match="mlp, forward, cpu: .*NaN or infinity"):
        measure_error(*tensors, "mlp, forward, cpu")


def test_worst_takes_maximum_and_rms_from_different_parts():
    assert largest_error([Error(3.0, 0.1), Error(1.0, 0.5)]) == Error(3.0, 0.5)

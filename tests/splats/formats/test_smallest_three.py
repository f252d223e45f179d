import numpy as np
import pytest

from hyrfpack.splats.formats.smallest_three import drop_largest, restore_largest
from hyrfpack.splats.splats import normalize_quats


@pytest.mark.parametrize("largest", range(4))
@pytest.mark.parametrize("sign", [1, -1])
def test_the_largest_component_is_omitted_and_made_positive(largest, sign):
    quats = np.insert([0.1, -0.2, 0.3], largest, 0.86**0.5)[None]
    number, others = drop_largest(sign * quats)
    assert number == [largest] and np.array_equal(others, [[0.1, -0.2, 0.3]])
    assert np.allclose(restore_largest(number, others), quats)


def test_rotations_round_trip_with_the_precision_of_the_bits():
    quats = normalize_quats(np.random.default_rng(0).normal(size=(1000, 4)))
    largest, others = drop_largest(quats)
    back = restore_largest(largest, others)
    assert back.dtype == np.float32 and np.abs(others).max() <= 0.5**0.5 + 1e-7
    assert np.allclose(np.abs((back * quats).sum(1)), 1, atol=1e-6)


def test_an_empty_array_of_rotations_round_trips():
    assert restore_largest(*drop_largest(np.zeros((0, 4)))).shape == (0, 4)

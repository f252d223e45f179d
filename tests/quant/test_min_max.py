from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from hyrfpack.quant import MinMaxParams, MinMaxQuantizer
from hyrfpack.quant.errors import DamagedDataError

FINITE_FLOAT32 = st.floats(width=32, allow_nan=False, allow_infinity=False)


@given(hnp.arrays(np.float32, hnp.array_shapes(max_dims=3, max_side=20), elements=FINITE_FLOAT32), st.integers(1, 16))
def test_error_stays_within_half_a_step_and_rounding(values: np.ndarray, bits: int) -> None:
    quantizer = MinMaxQuantizer(bits)

    codes, params = quantizer.encode(values)
    decoded = quantizer.decode(codes, params)

    assert codes.shape == decoded.shape == values.shape
    assert decoded.dtype == np.float32
    low, high = float(values.min()), float(values.max())
    smallest = 2.0**-149  # below the normal floats the rounding error is absolute
    bound = (high - low) / (2 * (2**bits - 1)) + 2.0**-23 * max(abs(low), abs(high)) + smallest
    assert np.abs(decoded.astype(np.float64) - values).max() <= bound


@given(hnp.arrays(np.float32, st.integers(1, 50), elements=FINITE_FLOAT32), st.integers(1, 16))
def test_codes_are_the_nearest_levels_by_exact_arithmetic(values: np.ndarray, bits: int) -> None:
    codes, params = MinMaxQuantizer(bits).encode(values)

    low, high = Fraction(params.minimum), Fraction(params.maximum)
    if high > low:
        for code, value in zip(codes.tolist(), values.tolist(), strict=True):
            place = (Fraction(value) - low) / (high - low) * (2**bits - 1)
            assert abs(place - code) <= Fraction(1, 2) + Fraction(1, 2**30)


@given(hnp.arrays(np.float32, st.integers(1, 50), elements=FINITE_FLOAT32), st.integers(1, 16))
def test_extremes_are_exact(values: np.ndarray, bits: int) -> None:
    decoded = MinMaxQuantizer.decode(*MinMaxQuantizer(bits).encode(values))

    assert decoded[values.argmin()] == values.min()
    assert decoded[values.argmax()] == values.max()


@pytest.mark.parametrize("value", [0.0, -0.1, 1e-42, 3.4e38])
def test_constant_channel_is_exact(value: float) -> None:
    values = np.full((7, 3), value, np.float32)

    decoded = MinMaxQuantizer.decode(*MinMaxQuantizer().encode(values))

    np.testing.assert_array_equal(decoded, values)


@pytest.mark.parametrize("values", [np.zeros((0, 4), np.float32), np.float32([2.5]), np.float32([-1, 7, 7, -1])])
def test_empty_one_and_two_values_are_exact(values: np.ndarray) -> None:
    decoded = MinMaxQuantizer.decode(*MinMaxQuantizer(1).encode(values))

    np.testing.assert_array_equal(decoded, values)
    assert decoded.shape == values.shape


def test_halfway_values_go_to_the_even_code() -> None:
    # The levels are 0, 0.25, 0.5 and 0.75; 0.125 and 0.375 lie halfway between two of them.
    values = np.float32([0.0, 0.125, 0.375, 0.49, 0.75])

    codes, params = MinMaxQuantizer(2).encode(values)

    assert codes.tolist() == [0, 0, 2, 2, 3]
    assert MinMaxQuantizer.decode(codes, params).tolist() == [0.0, 0.0, 0.5, 0.5, 0.75]


@pytest.mark.parametrize(("bits", "dtype"), [(1, np.uint8), (8, np.uint8), (9, np.uint16), (16, np.uint16)])
def test_code_dtype_is_the_narrowest_that_holds_the_bits(bits: int, dtype: type) -> None:
    codes, _ = MinMaxQuantizer(bits).encode(np.float32([0, 1]))

    assert codes.dtype == dtype
    assert codes.tolist() == [0, 2**bits - 1]


def test_encoding_leaves_its_input_unchanged() -> None:
    values = np.array([0.0, 0.3, 1.0])

    MinMaxQuantizer().encode(values)

    assert values.tolist() == [0.0, 0.3, 1.0]


def test_float64_values_between_float32_numbers_stay_within_the_error_bound() -> None:
    values = np.array([0.1, 0.2, 0.3])  # none of them is a float32 number

    decoded = MinMaxQuantizer.decode(*MinMaxQuantizer().encode(values))

    assert np.abs(decoded - values).max() <= 0.2 / 510 + 2.0**-23 * 0.3


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e39])
def test_values_that_are_not_finite_are_refused(bad: float) -> None:
    with pytest.raises(ValueError, match="finite"):
        MinMaxQuantizer().encode(np.array([0.0, bad, 1.0]))


@pytest.mark.parametrize("bits", [0, 17])
def test_bits_out_of_range_are_refused(bits: int) -> None:
    with pytest.raises(ValueError, match="bits"):
        MinMaxQuantizer(bits)


def test_codes_beyond_the_bits_are_refused() -> None:
    with pytest.raises(DamagedDataError, match="more than 4 bits"):
        MinMaxQuantizer.decode(np.array([3, 16], np.uint8), MinMaxParams(0.0, 1.0, 4))


@given(FINITE_FLOAT32, FINITE_FLOAT32, st.integers(1, 16))
def test_parameters_round_trip_in_nine_bytes(a: float, b: float, bits: int) -> None:
    params = MinMaxParams(min(a, b), max(a, b), bits)

    assert len(params.to_bytes()) == 9
    assert MinMaxParams.from_bytes(params.to_bytes()) == params


@pytest.mark.parametrize(
    "data",
    [
        b"",
        MinMaxParams(0.0, 1.0, 8).to_bytes()[:-1],
        MinMaxParams(0.0, 1.0, 8).to_bytes() + b"\0",
        MinMaxParams(1.0, 0.0, 8).to_bytes(),
        MinMaxParams(0.0, float("inf"), 8).to_bytes(),
        MinMaxParams(float("nan"), 1.0, 8).to_bytes(),
        MinMaxParams(0.0, 1.0, 0).to_bytes(),
        MinMaxParams(0.0, 1.0, 17).to_bytes(),
    ],
)
def test_damaged_parameters_are_refused(data: bytes) -> None:
    with pytest.raises(DamagedDataError, match="min-max parameters"):
        MinMaxParams.from_bytes(data)

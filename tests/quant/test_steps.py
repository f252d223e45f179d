from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from property_tests import examples

from hyrfpack.quant.steps import ALL_ZERO_CODE, FIXED_POINT_ONE, decode_step, encode_step

STEP_CODES = range(1, 256)


def step_by_definition(code: int) -> int:
    return (8 + code % 8) * 2 ** (code // 8)


def test_steps_equal_the_formula_and_increase() -> None:
    steps = decode_step(np.arange(1, 256, dtype=np.uint8))

    assert steps.dtype == np.int64
    assert steps.tolist() == [step_by_definition(code) for code in STEP_CODES]
    assert (np.diff(steps) > 0).all()


def test_steps_have_the_documented_range_and_ratios() -> None:
    steps = decode_step(np.arange(1, 256)) / FIXED_POINT_ONE

    assert steps[0] == pytest.approx(5.4e-7, rel=0.01)
    assert steps[-1] == 1920
    ratios = steps[1:] / steps[:-1] - 1
    assert ratios.min() == pytest.approx(1 / 15) and ratios.max() == pytest.approx(1 / 8)


def test_every_code_round_trips_through_its_step() -> None:
    assert encode_step(decode_step(np.arange(1, 256)) / FIXED_POINT_ONE).tolist() == list(STEP_CODES)
    assert [int(encode_step(float(decode_step(code)) / FIXED_POINT_ONE)) for code in STEP_CODES] == list(STEP_CODES)


@given(st.floats(1e-300, 1e300) | st.floats(math.log(1e-8), math.log(1e5)).map(math.exp))
@examples(200)
def test_encode_step_chooses_the_nearest_step_by_ratio(step: float) -> None:
    def distance(code: int) -> float:
        return abs(math.log(step_by_definition(code) / 2**24) - math.log(step))

    code = encode_step(step)

    assert code.dtype == np.uint8
    assert distance(int(code)) <= min(map(distance, STEP_CODES)) + 1e-9


@pytest.mark.parametrize(("step", "code"), [(0.0, 1), (1e-300, 1), (1e300, 255), (np.inf, 255)])
def test_steps_out_of_range_get_the_first_or_last_code(step: float, code: int) -> None:
    assert int(encode_step(step)) == code


@given(st.lists(st.floats(0, 1e6), max_size=50))
@examples(50)
def test_no_step_gets_the_code_for_all_zero(steps: list[float]) -> None:
    codes = encode_step(np.array(steps))

    assert codes.shape == (len(steps),)
    assert (codes != ALL_ZERO_CODE).all()

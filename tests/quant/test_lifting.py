from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from property_tests import examples

from hyrfpack.quant.lifting import inverse_lift, iter_levels, lift

VALUE_COUNTS = [0, 1, 2, 3, 4, 5, 7, 8, 9, 16, 17, 31, 100, 1000]
PREDICTION_WEIGHTS = st.sampled_from([0, 1, 6, 9, 12, 15, 16])


def inverse_lift_by_definition(residuals: list[int], weight: int, steps: list[int]) -> list[int]:
    """Apply the definition one number at a time; fractions are rounded down."""
    count, values = len(residuals), {}
    if count:
        values[0] = residuals[0] * steps[0]
    distance = 1
    while 2 * distance < count:
        distance *= 2
    while distance >= 1:
        for place in range(distance, count, 2 * distance):
            before = values[place - distance]
            after = values.get(place + distance, before)
            values[place] = residuals[place] * steps[place] + (before + after) * weight // 32
        distance //= 2
    return [values[place] for place in range(count)]


def choose_nearest_to(target: np.ndarray, steps: np.ndarray):
    def choose(places: np.ndarray, predictions: np.ndarray) -> np.ndarray:
        return np.rint((target[places] - predictions) / steps[places]).astype(np.int64)

    return choose


@given(st.data())
@examples(150)
def test_inverse_lift_follows_the_definition(data: st.DataObject) -> None:
    pairs = data.draw(st.lists(st.tuples(st.integers(-(2**14), 2**14), st.integers(1, 2**24)), max_size=70))
    weight = data.draw(PREDICTION_WEIGHTS)
    residuals, steps = [residual for residual, _ in pairs], [step for _, step in pairs]

    values = inverse_lift(np.array(residuals, np.int64), weight, np.array(steps, np.int64))

    assert values.dtype == np.int64
    assert values.tolist() == inverse_lift_by_definition(residuals, weight, steps)


@pytest.mark.parametrize("weight", [0, 9, 16])
@pytest.mark.parametrize("count", VALUE_COUNTS)
def test_inverse_lift_returns_the_values_that_lift_announced(count: int, weight: int) -> None:
    rng = np.random.default_rng(count)
    target = np.cumsum(rng.integers(-(2**30), 2**30, count))
    steps = rng.integers(1, 2**28, count)

    residuals, values = lift(count, weight, steps, choose_nearest_to(target, steps))

    np.testing.assert_array_equal(inverse_lift(residuals, weight, steps), values)
    assert values.tolist() == inverse_lift_by_definition(residuals.tolist(), weight, steps.tolist())
    assert (2 * np.abs(values - target) <= steps).all()


@given(st.data())
@examples(60)
def test_any_chosen_residuals_round_trip(data: st.DataObject) -> None:
    count, weight, seed = data.draw(st.integers(0, 80)), data.draw(PREDICTION_WEIGHTS), data.draw(st.integers(0, 99))
    steps = np.random.default_rng(seed).integers(1, 2**34, count)
    chosen = np.random.default_rng(seed + 1).integers(-100, 100, count)

    residuals, values = lift(count, weight, steps, lambda places, predictions: chosen[places])

    np.testing.assert_array_equal(residuals, chosen)
    np.testing.assert_array_equal(inverse_lift(residuals, weight, steps), values)


@pytest.mark.parametrize("count", VALUE_COUNTS)
def test_iter_levels_visits_every_index_once_after_its_neighbours(count: int) -> None:
    seen = [0] if count else []

    for places, distance in iter_levels(count):
        for place in places.tolist():
            assert place - distance in seen
            assert place + distance in seen or place + distance >= count
        seen += places.tolist()

    assert sorted(seen) == list(range(count))


@pytest.mark.parametrize("count", VALUE_COUNTS)
def test_choose_is_called_once_for_each_index_with_its_prediction(count: int) -> None:
    asked: dict[int, int] = {}
    steps = np.full(count, 3)

    def choose(places: np.ndarray, predictions: np.ndarray) -> np.ndarray:
        assert not asked.keys() & set(places.tolist())
        asked.update(zip(places.tolist(), predictions.tolist(), strict=True))
        return places % 7 - 3

    residuals, values = lift(count, 16, steps, choose)

    assert sorted(asked) == list(range(count))
    assert [asked[place] + 3 * int(residuals[place]) for place in range(count)] == values.tolist()


def test_straight_line_leaves_one_nonzero_residual() -> None:
    line = 1000 * np.arange(65)
    steps = np.ones(65, np.int64)

    residuals, values = lift(65, 16, steps, choose_nearest_to(line, steps))

    np.testing.assert_array_equal(values, line)
    assert np.flatnonzero(residuals).tolist() == [64]  # the value at index 0 is zero and needs no residual


def test_weight_zero_predicts_nothing() -> None:
    residuals, steps = np.array([3, -1, 4, 1, -5]), np.array([9, 2, 6, 5, 3])

    assert inverse_lift(residuals, 0, steps).tolist() == [27, -2, 24, 5, -15]


def test_inverse_lift_accepts_int32_and_leaves_its_arguments_unchanged() -> None:
    residuals, steps = np.full(9, 2**31 - 1, np.int32), np.full(9, 2**10)

    values = inverse_lift(residuals, 16, steps)

    assert (residuals == 2**31 - 1).all() and (steps == 2**10).all()
    assert values.tolist() == inverse_lift_by_definition(residuals.tolist(), 16, steps.tolist())

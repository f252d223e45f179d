from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hyrfpack.quant.lifting import inverse_lift, iter_levels, lift

COUNTS = [0, 1, 2, 3, 4, 5, 7, 8, 9, 16, 17, 31, 100, 1000]
WEIGHT = st.sampled_from([0, 1, 6, 9, 12, 15, 16])


def unlift_by_the_book(residuals: list[int], weight: int, steps: list[int]) -> list[int]:
    """The definition, a number at a time; fractions are rounded down."""
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


def nearest_to(target: np.ndarray, steps: np.ndarray):
    def choose(places: np.ndarray, predictions: np.ndarray) -> np.ndarray:
        return np.rint((target[places] - predictions) / steps[places]).astype(np.int64)

    return choose


@given(st.data())
@settings(max_examples=150, deadline=None)
def test_unlift_is_the_definition(data: st.DataObject) -> None:
    pairs = data.draw(st.lists(st.tuples(st.integers(-(2**14), 2**14), st.integers(1, 2**24)), max_size=70))
    weight = data.draw(WEIGHT)
    residuals, steps = [residual for residual, _ in pairs], [step for _, step in pairs]

    values = inverse_lift(np.array(residuals, np.int64), weight, np.array(steps, np.int64))

    assert values.dtype == np.int64
    assert values.tolist() == unlift_by_the_book(residuals, weight, steps)


@pytest.mark.parametrize("weight", [0, 9, 16])
@pytest.mark.parametrize("count", COUNTS)
def test_unlift_gives_what_lift_said_it_would(count: int, weight: int) -> None:
    rng = np.random.default_rng(count)
    target = np.cumsum(rng.integers(-(2**30), 2**30, count))
    steps = rng.integers(1, 2**28, count)

    residuals, values = lift(count, weight, steps, nearest_to(target, steps))

    np.testing.assert_array_equal(inverse_lift(residuals, weight, steps), values)
    assert values.tolist() == unlift_by_the_book(residuals.tolist(), weight, steps.tolist())
    assert (2 * np.abs(values - target) <= steps).all()


@given(st.data())
@settings(max_examples=60, deadline=None)
def test_any_choice_of_differences_comes_back(data: st.DataObject) -> None:
    count, weight, seed = data.draw(st.integers(0, 80)), data.draw(WEIGHT), data.draw(st.integers(0, 99))
    steps = np.random.default_rng(seed).integers(1, 2**34, count)
    chosen = np.random.default_rng(seed + 1).integers(-100, 100, count)

    residuals, values = lift(count, weight, steps, lambda places, predictions: chosen[places])

    np.testing.assert_array_equal(residuals, chosen)
    np.testing.assert_array_equal(inverse_lift(residuals, weight, steps), values)


@pytest.mark.parametrize("count", COUNTS)
def test_every_place_comes_once_and_after_its_neighbours(count: int) -> None:
    seen = [0] if count else []

    for places, distance in iter_levels(count):
        for place in places.tolist():
            assert place - distance in seen
            assert place + distance in seen or place + distance >= count
        seen += places.tolist()

    assert sorted(seen) == list(range(count))


@pytest.mark.parametrize("count", COUNTS)
def test_the_encoder_chooses_once_for_each_place_and_knows_the_prediction(count: int) -> None:
    asked: dict[int, int] = {}
    steps = np.full(count, 3)

    def choose(places: np.ndarray, predictions: np.ndarray) -> np.ndarray:
        assert not asked.keys() & set(places.tolist())
        asked.update(zip(places.tolist(), predictions.tolist(), strict=True))
        return places % 7 - 3

    residuals, values = lift(count, 16, steps, choose)

    assert sorted(asked) == list(range(count))
    assert [asked[place] + 3 * int(residuals[place]) for place in range(count)] == values.tolist()


def test_a_straight_line_is_predicted_by_its_ends() -> None:
    line = 1000 * np.arange(65)
    steps = np.ones(65, np.int64)

    residuals, values = lift(65, 16, steps, nearest_to(line, steps))

    np.testing.assert_array_equal(values, line)
    assert np.flatnonzero(residuals).tolist() == [64]  # number 0 is zero itself


def test_without_a_weight_nothing_is_predicted() -> None:
    residuals, steps = np.array([3, -1, 4, 1, -5]), np.array([9, 2, 6, 5, 3])

    assert inverse_lift(residuals, 0, steps).tolist() == [27, -2, 24, 5, -15]


def test_unlift_leaves_its_arguments_alone_and_takes_narrow_integers() -> None:
    residuals, steps = np.full(9, 2**31 - 1, np.int32), np.full(9, 2**10)

    values = inverse_lift(residuals, 16, steps)

    assert (residuals == 2**31 - 1).all() and (steps == 2**10).all()
    assert values.tolist() == unlift_by_the_book(residuals.tolist(), 16, steps.tolist())

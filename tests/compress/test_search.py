from __future__ import annotations

import math

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from hyrfpack.compress.search import (
    ACCEPTED_SIZE_RATIO,
    BRACKETING_RATIO,
    TARGET_SIZE_RATIO,
    find_coarsest,
    find_fullest,
)

ENDS = (1e-8, 1e-2)
noises = st.floats(math.log(ENDS[0]), math.log(ENDS[1])).map(math.exp).filter(lambda x: ENDS[0] <= x <= ENDS[1])


class Attempts:
    """Trials are their distortions; remembers them."""

    def __init__(self) -> None:
        self.made: list[float] = []

    def __call__(self, noise: float) -> float:
        self.made.append(noise)
        return noise


def worst_ratio(limit: float, start: float, trials: int) -> float:
    """Steps by BRACKETING_RATIO until two trials bracket the limit; those left halve the logarithm of their ratio."""
    steps = 2 + math.floor(abs(math.log(limit / start, BRACKETING_RATIO)) + 1e-9)
    return BRACKETING_RATIO**2.0 ** -(trials - steps) if trials >= steps else math.inf


@given(limit=noises, start=noises, trials=st.integers(2, 14))
def test_the_coarsest_that_fits_is_found_as_nearly_as_the_trials_allow(limit, start, trials):
    attempts = Attempts()

    answer = find_coarsest(attempts, lambda trial: trial <= limit, start, trials, ENDS)

    assert len(attempts.made) <= trials + 1 and all(ENDS[0] <= noise <= ENDS[1] for noise in attempts.made)
    noise, trial = answer
    assert noise == trial <= limit
    assert noise == max(noise for noise in attempts.made if noise <= limit)
    assert limit / noise <= worst_ratio(limit, start, trials) * (1 + 1e-9)


@given(start=noises, trials=st.integers(2, 14))
def test_where_nothing_fits_there_is_no_answer(start, trials):
    attempts = Attempts()

    assert find_coarsest(attempts, lambda trial: False, start, trials, ENDS) is None

    assert min(attempts.made) == ENDS[0] and attempts.made.count(ENDS[0]) == 1


@given(start=noises)
def test_where_everything_fits_the_end_is_the_answer_and_tried_once(start):
    attempts = Attempts()

    assert find_coarsest(attempts, lambda trial: True, start, 14, ENDS) == (ENDS[1], ENDS[1])

    assert attempts.made.count(ENDS[1]) == 1


@pytest.mark.parametrize("start", [0.0, 1e-30, 1e-8, 1e-2, 7.0, math.inf])
def test_a_start_beyond_the_ends_begins_at_the_nearer_one(start):
    attempts = Attempts()

    find_coarsest(attempts, lambda trial: trial <= 1e-5, start, 12, ENDS)

    assert attempts.made[0] == min(max(start, ENDS[0]), ENDS[1])


@given(limit=noises, start=noises)
def test_the_trial_that_is_returned_is_the_one_that_was_made(limit, start):
    """Trials are files: the answer is one of them, not made anew."""
    assume(limit > ENDS[0])
    made = []

    def attempt(noise: float) -> list[float]:
        made.append([noise])
        return made[-1]

    _, trial = find_coarsest(attempt, lambda trial: trial[0] <= limit, start, 10, ENDS)

    assert any(trial is other for other in made)


# -- bytes -----------------------------------------------------------------------------------------------------------


def bytes_by(slope: float, at_start: float = 1e5, start: float = 1e-5):
    """Sizes of files that fall as a power of the distortion."""
    return lambda noise: int(at_start * (noise / start) ** slope)


@given(limit=st.floats(6e4, 1.6e5), slope=st.floats(-0.4, -0.15))
def test_of_sizes_that_fall_as_a_power_three_trials_use_up_the_limit(limit, slope):
    attempts, size = Attempts(), bytes_by(slope)
    assume(size(ENDS[0]) > limit > size(ENDS[1]))

    noise, trial = find_fullest(attempts, size, limit, 1e-5, 9, ENDS)

    assert noise == trial and ACCEPTED_SIZE_RATIO * limit <= size(trial) <= limit
    assert len(attempts.made) <= 3


@given(limit=st.floats(1e3, 1e6), slope=st.floats(-2, -0.02), jump=st.floats(1, 1.5), start=noises)
def test_of_any_sizes_that_fall_the_largest_that_was_tried_and_fits_is_the_answer(limit, slope, jump, start):
    attempts, smooth = Attempts(), bytes_by(slope)

    def size(noise: float) -> int:
        return int(smooth(noise) * (jump if noise < 3e-5 else 1))

    answer = find_fullest(attempts, size, limit, start, 9, ENDS)

    fitting = [noise for noise in attempts.made if size(noise) <= limit]
    assert len(attempts.made) <= 9 and all(0.99 * ENDS[0] < noise < 1.01 * ENDS[1] for noise in attempts.made)
    assert answer == ((min(fitting),) * 2 if fitting else None)
    if not fitting and len(attempts.made) < 9:
        assert max(attempts.made) == pytest.approx(ENDS[1])


def test_a_jump_in_the_sizes_ends_the_search():
    """Sizes move in jumps: where there is nothing between two of them, trials are not wasted."""
    attempts = Attempts()

    noise, _ = find_fullest(attempts, lambda noise: 200_000 if noise < 2e-5 else 90_000, 100_000, 1e-5, 50, ENDS)

    assert 2e-5 <= noise < 2.1e-5 and len(attempts.made) < 16
    assert TARGET_SIZE_RATIO > ACCEPTED_SIZE_RATIO

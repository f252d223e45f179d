from __future__ import annotations

import math

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from hyrfpack.compress import distortion
from hyrfpack.compress.limits import EncodedCandidate, encode_within_bytes
from hyrfpack.compress.search import (
    ACCEPTED_SIZE_RATIO,
    BRACKETING_RATIO,
    TARGET_SIZE_RATIO,
    find_coarsest,
    find_fullest,
)
from hyrfpack.errors import HyrfSizeError
from hyrfpack.progress import Progress, ignore_progress

DISTORTION_RANGE = (1e-8, 1e-2)
distortions = (
    st.floats(math.log(DISTORTION_RANGE[0]), math.log(DISTORTION_RANGE[1]))
    .map(math.exp)
    .filter(lambda x: DISTORTION_RANGE[0] <= x <= DISTORTION_RANGE[1])
)


class RecordingTrials:
    """Callable that returns each distortion as its trial and records it."""

    def __init__(self) -> None:
        self.made: list[float] = []

    def __call__(self, noise: float) -> float:
        self.made.append(noise)
        return noise


def worst_ratio(limit: float, start: float, trials: int) -> float:
    """Return the worst ratio of limit to result for a bracketing search.

    Steps by BRACKETING_RATIO bracket the limit; each further trial halves the logarithm of the bracket's ratio.
    """
    steps = 2 + math.floor(abs(math.log(limit / start, BRACKETING_RATIO)) + 1e-9)
    return BRACKETING_RATIO**2.0 ** -(trials - steps) if trials >= steps else math.inf


@given(limit=distortions, start=distortions, trials=st.integers(2, 14))
def test_the_coarsest_fitting_distortion_is_found_within_the_trials(limit, start, trials):
    recorded = RecordingTrials()

    answer = find_coarsest(recorded, lambda trial: trial <= limit, start, trials, DISTORTION_RANGE)

    assert len(recorded.made) <= trials + 1 and all(
        DISTORTION_RANGE[0] <= noise <= DISTORTION_RANGE[1] for noise in recorded.made
    )
    noise, trial = answer
    assert noise == trial <= limit
    assert noise == max(noise for noise in recorded.made if noise <= limit)
    assert limit / noise <= worst_ratio(limit, start, trials) * (1 + 1e-9)


@given(start=distortions, trials=st.integers(2, 14))
def test_the_search_returns_none_if_nothing_fits(start, trials):
    recorded = RecordingTrials()

    assert find_coarsest(recorded, lambda trial: False, start, trials, DISTORTION_RANGE) is None

    assert min(recorded.made) == DISTORTION_RANGE[0] and recorded.made.count(DISTORTION_RANGE[0]) == 1


@given(start=distortions)
def test_the_search_returns_the_coarsest_end_if_everything_fits(start):
    recorded = RecordingTrials()

    assert find_coarsest(recorded, lambda trial: True, start, 14, DISTORTION_RANGE) == (
        DISTORTION_RANGE[1],
        DISTORTION_RANGE[1],
    )

    assert recorded.made.count(DISTORTION_RANGE[1]) == 1


@pytest.mark.parametrize("start", [0.0, 1e-30, 1e-8, 1e-2, 7.0, math.inf])
def test_a_start_outside_the_range_is_clipped(start):
    recorded = RecordingTrials()

    find_coarsest(recorded, lambda trial: trial <= 1e-5, start, 12, DISTORTION_RANGE)

    assert recorded.made[0] == min(max(start, DISTORTION_RANGE[0]), DISTORTION_RANGE[1])


@given(limit=distortions, start=distortions)
def test_the_returned_trial_is_one_that_was_made(limit, start):
    """Trials are files, so that the result must be one of them and not a new one."""
    assume(limit > DISTORTION_RANGE[0])
    recorded = []

    def make_trial(noise: float) -> list[float]:
        recorded.append([noise])
        return recorded[-1]

    _, trial = find_coarsest(make_trial, lambda trial: trial[0] <= limit, start, 10, DISTORTION_RANGE)

    assert any(trial is other for other in recorded)


# -- bytes -----------------------------------------------------------------------------------------------------------


def power_law_bytes(slope: float, at_start: float = 1e5, start: float = 1e-5):
    """Return a function for file sizes that fall as a power of the distortion."""
    return lambda noise: int(at_start * (noise / start) ** slope)


@given(limit=st.floats(6e4, 1.6e5), slope=st.floats(-0.4, -0.15))
def test_three_trials_nearly_reach_the_limit_for_power_law_sizes(limit, slope):
    recorded, size = RecordingTrials(), power_law_bytes(slope)
    assume(size(DISTORTION_RANGE[0]) > limit > size(DISTORTION_RANGE[1]))

    noise, trial = find_fullest(recorded, size, limit, 1e-5, 9, DISTORTION_RANGE)

    assert noise == trial and ACCEPTED_SIZE_RATIO * limit <= size(trial) <= limit
    assert len(recorded.made) <= 3


@given(limit=st.floats(1e3, 1e6), slope=st.floats(-2, -0.02), jump=st.floats(1, 1.5), start=distortions)
def test_the_search_returns_the_largest_fitting_trial(limit, slope, jump, start):
    recorded, smooth = RecordingTrials(), power_law_bytes(slope)

    def size(noise: float) -> int:
        return int(smooth(noise) * (jump if noise < 3e-5 else 1))

    answer = find_fullest(recorded, size, limit, start, 9, DISTORTION_RANGE)

    fitting = [noise for noise in recorded.made if size(noise) <= limit]
    assert len(recorded.made) <= 10 and all(
        0.99 * DISTORTION_RANGE[0] < noise < 1.01 * DISTORTION_RANGE[1] for noise in recorded.made
    )
    if fitting:
        assert answer == (min(fitting),) * 2
    else:
        assert answer == (DISTORTION_RANGE[1], recorded.made[-1])
        largest = (1 - 1e-9) * DISTORTION_RANGE[1]  # up to rounding; another trial may come close to it
        assert [noise for noise in recorded.made if noise > largest] == recorded.made[-1:]


def test_a_jump_in_the_sizes_ends_the_search():
    """Where sizes jump, no trials are wasted between the two sides of the jump."""
    recorded = RecordingTrials()

    noise, _ = find_fullest(
        recorded, lambda noise: 200_000 if noise < 2e-5 else 90_000, 100_000, 1e-5, 50, DISTORTION_RANGE
    )

    assert 2e-5 <= noise < 2.1e-5 and len(recorded.made) < 16
    assert TARGET_SIZE_RATIO > ACCEPTED_SIZE_RATIO


def test_a_search_without_further_trials_takes_the_largest_distortion_if_that_fits() -> None:
    def encode(value: float, progress: Progress) -> EncodedCandidate:
        return EncodedCandidate(bytes(10 if value == distortion.DISTORTION_RANGE[1] else 1000), {})

    candidate, _ = encode_within_bytes(encode, 500, 1e-6, ignore_progress, trials=2)
    assert len(candidate.data) == 10
    with pytest.raises(HyrfSizeError) as caught:
        encode_within_bytes(encode, 5, 1e-6, ignore_progress, trials=2)
    assert caught.value.min_bytes == 10

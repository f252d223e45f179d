"""Search for the largest distortion whose file meets a limit on size or loss, both monotone in the distortion."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TypeVar

Trial = TypeVar("Trial")
# Until trials bracket the answer, the distortion is multiplied or divided by this ratio.
BRACKETING_RATIO = 4.0
# Trials aim at TARGET_SIZE_RATIO of the size limit. One of at least ACCEPTED_SIZE_RATIO of the limit ends the search.
ACCEPTED_SIZE_RATIO = 0.97
TARGET_SIZE_RATIO = 0.985
# Typical d log bytes / d log distortion, used while there is only one trial.
LOG_SIZE_SLOPE = -0.22
MAX_LOG_STEP = math.log(256)
# A trial stays away from the ends of the bracket by 1 / BRACKET_MARGIN_PARTS of its width.
BRACKET_MARGIN_PARTS = 20
# After this many trials the bracket is halved instead of interpolated.
MAX_INTERPOLATED_TRIALS = 5
# Sizes change in jumps, so a narrower bracket is not searched.
MIN_BRACKET_LOG_WIDTH = math.log(1.01)


def find_coarsest(
    make_trial: Callable[[float], Trial],
    fits: Callable[[Trial], bool],
    start: float,
    trials: int,
    bounds: tuple[float, float],
) -> tuple[float, Trial] | None:
    """Find the largest distortion whose trial fits, by bracketing and bisection of its logarithm.

    Args:
        make_trial: makes the trial of a distortion; if a trial fits, those of smaller distortions fit too.
        fits: returns whether a trial is good enough.
        start: distortion of the first trial.
        trials: maximum number of trials, at least 2. If none of them fits, the smallest distortion is tried, too.
        bounds: smallest and largest distortion.

    Returns:
        The distortion and its trial; None if not even the smallest distortion fits.
    """
    # The bracket is from the largest distortion that fits to the smallest one that does not fit.
    low: float | None = None
    high: float | None = None
    distortion, best = min(max(start, bounds[0]), bounds[1]), None
    for _ in range(trials):
        trial = make_trial(distortion)
        if fits(trial):
            low, best = distortion, (distortion, trial)
        else:
            high = distortion
        if low == bounds[1] or high == bounds[0]:
            break
        if low is not None and high is not None:
            distortion = (low * high) ** 0.5
        else:
            distortion = (
                min(distortion * BRACKETING_RATIO, bounds[1])
                if high is None
                else max(distortion / BRACKETING_RATIO, bounds[0])
            )
    if best is None and high != bounds[0] and fits(trial := make_trial(bounds[0])):
        best = bounds[0], trial
    return best


def find_fullest(
    make_trial: Callable[[float], Trial],
    size: Callable[[Trial], int],
    limit: int,
    start: float,
    trials: int,
    bounds: tuple[float, float],
) -> tuple[float, Trial]:
    """Find a distortion whose trial takes at most `limit` bytes and at least ACCEPTED_SIZE_RATIO of them.

    The size falls roughly as a power of the distortion. The next distortion is found by interpolation through the last
    trials in logarithms, or from one trial with the typical slope. Two or three trials usually suffice.

    Args:
        size: returns the bytes of a trial; a larger distortion never takes more bytes.
        limit: maximum size in bytes.
        make_trial, start, bounds: as for `find_coarsest`.
        trials: maximum number of trials. If none of them fits, the largest distortion is tried, too.

    Returns:
        The distortion and the largest trial that fits; if none does, the largest distortion and its trial.
    """
    largest = bounds[1]
    bounds = math.log(bounds[0]), math.log(bounds[1])
    wanted, place = math.log(TARGET_SIZE_RATIO * limit), min(max(_log(start), bounds[0]), bounds[1])
    best: tuple[float, Trial] | None = None
    trial: Trial | None = None
    # The pairs are logarithms of a distortion and of its bytes: for the smallest distortion that fits, for the largest
    # that does not fit, and for each trial.
    fitting: tuple[float, float] | None = None
    too_large: tuple[float, float] | None = None
    measured: list[tuple[float, float]] = []
    for _ in range(trials):
        distortion = math.exp(place)
        trial = make_trial(distortion)
        measured.append((place, math.log(max(size(trial), 1))))
        if size(trial) <= limit:
            fitting, best = measured[-1], (distortion, trial)
        else:
            too_large = measured[-1]
        if fitting and (fitting[1] >= math.log(ACCEPTED_SIZE_RATIO * limit) or fitting[0] <= bounds[0]):
            break
        if too_large and too_large[0] >= bounds[1]:
            break
        if fitting and too_large and fitting[0] - too_large[0] < MIN_BRACKET_LOG_WIDTH:
            break
        place = _interpolate(measured, wanted)
        low, high = too_large[0] if too_large else bounds[0], fitting[0] if fitting else bounds[1]
        if fitting and too_large:
            edge = (high - low) / BRACKET_MARGIN_PARTS
            place = (
                (low + high) / 2
                if len(measured) > MAX_INTERPOLATED_TRIALS
                else min(max(place, low + edge), high - edge)
            )
        place = min(max(place, low), high)
    if best is not None:
        return best
    has_largest = too_large is not None and too_large[0] >= bounds[1]
    return largest, trial if has_largest and trial is not None else make_trial(largest)


def _interpolate(measured: list[tuple[float, float]], wanted: float) -> float:
    """Return x(wanted) of the Lagrange polynomial x(y) through the last three points (x, y), or two.

    From a single point, or from points of equal y, it extrapolates with LOG_SIZE_SLOPE by at most MAX_LOG_STEP.
    """
    points = measured[-3:]
    if len(points) < 2 or len({y for _, y in points}) < len(points):
        x, y = measured[-1]
        return x + min(max((wanted - y) / LOG_SIZE_SLOPE, -MAX_LOG_STEP), MAX_LOG_STEP)
    terms = (
        x * math.prod((wanted - other) / (y - other) for k, (_, other) in enumerate(points) if k != n)
        for n, (x, y) in enumerate(points)
    )
    return sum(terms)


def _log(value: float) -> float:
    return math.log(value) if value > 0 else -math.inf

"""Finding how coarse a file may be: a monotone search for one number."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TypeVar

Trial = TypeVar("Trial")
FACTOR = 4.0  # that the distortion is changed by until the answer is between two trials
ENOUGH, AIM = 0.97, 0.985  # of a limit on bytes: what need not be improved upon, and what is aimed at
SLOPE = -0.22  # d log bytes / d log distortion, about
FARTHEST = math.log(256)  # of the second trial from the first
EDGE, PATIENCE = 20, 5  # parts of what is left that a trial keeps from its ends; trials after which it is halved
NARROWEST = math.log(1.01)  # distortions between which there is nothing to be found: sizes move in jumps


def coarsest(
    attempt: Callable[[float], Trial],
    fits: Callable[[Trial], bool],
    start: float,
    trials: int,
    ends: tuple[float, float],
) -> tuple[float, Trial] | None:
    """The largest distortion whose trial fits, as far as a number of trials tells.

    Args:
        attempt: distortion -> trial; a smaller one fits if a larger does.
        fits: whether a trial is fine enough.
        start: distortion to begin with.
        trials: how many may be made, at least 2.
        ends: least and largest distortion.

    Returns:
        The distortion and its trial, None when not even the least distortion fits.
    """
    low: float | None = None  # the coarsest that fits
    high: float | None = None  # the finest that does not
    distortion, best = min(max(start, ends[0]), ends[1]), None
    for _ in range(trials):
        trial = attempt(distortion)
        if fits(trial):
            low, best = distortion, (distortion, trial)
        else:
            high = distortion
        if low == ends[1] or high == ends[0]:
            break
        if low is not None and high is not None:
            distortion = (low * high) ** 0.5
        else:
            distortion = min(distortion * FACTOR, ends[1]) if high is None else max(distortion / FACTOR, ends[0])
    if best is None and high != ends[0] and fits(trial := attempt(ends[0])):
        best = ends[0], trial
    return best


def fullest(
    attempt: Callable[[float], Trial],
    size: Callable[[Trial], int],
    limit: int,
    start: float,
    trials: int,
    ends: tuple[float, float],
) -> tuple[float, Trial] | None:
    """A distortion whose trial takes at most `limit` bytes and at least ENOUGH of them; usually in two or three trials.

    Bytes fall about as a power of the distortion: a line through two trials in logarithms, or through one with the
    slope that most models have, tells where to look next.

    Args:
        size: bytes of a trial; a larger distortion gives no more of them.
        limit: of the bytes.
        attempt, start, trials, ends: as of `coarsest`.

    Returns:
        The distortion and the trial with the most bytes of those that fit; None where none does.
    """
    ends = math.log(ends[0]), math.log(ends[1])
    wanted, place = math.log(AIM * limit), min(max(_log(start), ends[0]), ends[1])
    best: tuple[float, Trial] | None = None
    fitting: tuple[float, float] | None = None  # logarithms of the least distortion that fits, and of its bytes
    larger: tuple[float, float] | None = None  # of the greatest that does not
    made: list[tuple[float, float]] = []  # logarithms of distortions and bytes
    for _ in range(trials):
        distortion = math.exp(place)
        trial = attempt(distortion)
        made.append((place, math.log(max(size(trial), 1))))
        if size(trial) <= limit:
            fitting, best = made[-1], (distortion, trial)
        else:
            larger = made[-1]
        if fitting and (fitting[1] >= math.log(ENOUGH * limit) or fitting[0] <= ends[0]):
            break
        if larger and larger[0] >= ends[1]:
            break
        if fitting and larger and fitting[0] - larger[0] < NARROWEST:
            break
        place = _further(made, wanted)
        low, high = larger[0] if larger else ends[0], fitting[0] if fitting else ends[1]
        if fitting and larger:
            edge = (high - low) / EDGE
            place = (low + high) / 2 if len(made) > PATIENCE else min(max(place, low + edge), high - edge)
        place = min(max(place, low), high)
    return best


def _further(made: list[tuple[float, float]], wanted: float) -> float:
    """Where y = wanted on the curve x(y) through the last points (x, y): a parabola, or less where there are fewer."""
    points = made[-3:]
    if len(points) < 2 or len({y for _, y in points}) < len(points):
        x, y = made[-1]
        return x + min(max((wanted - y) / SLOPE, -FARTHEST), FARTHEST)
    terms = (
        x * math.prod((wanted - other) / (y - other) for k, (_, other) in enumerate(points) if k != n)
        for n, (x, y) in enumerate(points)
    )
    return sum(terms)


def _log(value: float) -> float:
    return math.log(value) if value > 0 else -math.inf

"""Finding how coarse a file may be: a monotone search for one number."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

Trial = TypeVar("Trial")
FACTOR = 4.0  # that the distortion is changed by until the answer is between two trials


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


def finest(
    attempt: Callable[[float], Trial],
    fits: Callable[[Trial], bool],
    start: float,
    trials: int,
    ends: tuple[float, float],
) -> tuple[float, Trial] | None:
    """The least distortion whose trial fits, where a larger one fits if a smaller does; arguments as `coarsest`."""
    mirrored = coarsest(lambda inverse: attempt(1 / inverse), fits, 1 / start, trials, (1 / ends[1], 1 / ends[0]))
    return None if mirrored is None else (1 / mirrored[0], mirrored[1])

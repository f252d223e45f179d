"""Fair times on a machine that is not quiet: medians over repeats in which the contenders take turns."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from time import perf_counter, process_time
from typing import Any

import numpy as np

ENOUGH_SECONDS = 3.0
WARM_SECONDS = 0.1

# Runs a task; returns what it returned, and its wall and processor time in seconds.
Clock = Callable[[Callable[[], Any]], tuple[Any, float, float]]


@dataclass(frozen=True)
class Ratio:
    """Of the median times of two tasks that took turns: wall, and processor (None where its clock is too coarse)."""

    wall: float
    work: float | None


@dataclass(frozen=True)
class Timing:
    """How long a task takes.

    Attributes:
        ms: median wall time.
        spread_ms: interquartile range of the wall times; None when there is only one.
        work_ms: median processor time, summed over all threads; what a busy machine distorts least.
        repeats: how many times were measured.
    """

    ms: float
    spread_ms: float | None
    work_ms: float
    repeats: int

    def each(self, count: int) -> Timing:
        """The time of one out of `count` equal parts of the task."""
        spread = None if self.spread_ms is None else self.spread_ms / count
        return Timing(self.ms / count, spread, self.work_ms / count, self.repeats)

    def over(self, reference: Timing) -> Ratio:
        """How many times the reference's time this is."""
        return Ratio(self.ms / reference.ms, self.work_ms / reference.work_ms if reference.work_ms else None)


def take_turns(
    tasks: Mapping[str, Callable[[], Any]], repeats: int, clock: Clock | None = None
) -> tuple[dict[str, Timing], dict[str, Any]]:
    """Time tasks against each other: each runs once unmeasured, then all take turns.

    A task leaves the round once it has been measured for ENOUGH_SECONDS. One whose first run alone took that long
    is not run again: that run is its time. One that takes less than WARM_SECONDS is run unmeasured for that long at the
    start of each turn: a slower neighbour leaves cold caches, and one core for all threads until the system spreads
    them again, which is not the task's own time.

    Args:
        tasks: by name.
        repeats: turns of each task; at least 1.
        clock: another one than the processor's; it does its own warming.

    Returns:
        The timing of each task, and what its first run returned.
    """
    results: dict[str, Any] = {}
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in tasks}
    quick, measure = set(), clock or _measure
    for name, task in tasks.items():
        results[name], wall, work = measure(task)
        if wall >= ENOUGH_SECONDS:
            times[name].append((wall, work))
        elif wall < WARM_SECONDS and clock is None:
            quick.add(name)
    for _ in range(repeats):
        for name, task in tasks.items():
            if sum(wall for wall, _ in times[name]) < ENOUGH_SECONDS:
                end = perf_counter() + WARM_SECONDS
                while name in quick and perf_counter() < end:
                    task()
                _, wall, work = measure(task)
                times[name].append((wall, work))
    return {name: _summary(measured) for name, measured in times.items()}, results


def _measure(task: Callable[[], Any]) -> tuple[Any, float, float]:
    wall, work = perf_counter(), process_time()
    result = task()
    return result, perf_counter() - wall, process_time() - work


def _summary(seconds: list[tuple[float, float]]) -> Timing:
    wall, work = 1e3 * np.array(seconds).T
    low, high = np.percentile(wall, (25, 75))
    return Timing(
        ms=float(np.median(wall)),
        spread_ms=float(high - low) if len(wall) > 1 else None,
        work_ms=float(np.median(work)),
        repeats=len(wall),
    )

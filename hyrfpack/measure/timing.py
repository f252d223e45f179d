"""Time tasks fairly on a busy machine: the tasks run alternately, and the median of the repeats counts."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from time import perf_counter, process_time
from typing import Any

import numpy as np

MAX_SECONDS_PER_TASK = 3.0
WARM_UP_SECONDS = 0.1

# Runs a task; returns its result, and its wall time and processor time in seconds.
Clock = Callable[[Callable[[], Any]], tuple[Any, float, float]]


@dataclass(frozen=True)
class Ratio:
    """Ratio of the median times of two tasks that ran alternately.

    Attributes:
        wall: ratio of the wall times.
        work: ratio of the processor times; None if the processor clock is too coarse.
    """

    wall: float
    work: float | None


@dataclass(frozen=True)
class Timing:
    """Run time of a task over several repeats.

    Attributes:
        ms: median wall time in milliseconds.
        spread_ms: interquartile range of the wall times in milliseconds; None if there is only one.
        work_ms: median processor time in milliseconds, summed over all threads; other programs on the machine distort
            it less than the wall time.
        repeats: number of measured runs.
    """

    ms: float
    spread_ms: float | None
    work_ms: float
    repeats: int

    def per_part(self, count: int) -> Timing:
        """Return the time of one of `count` equal parts of the task."""
        spread = None if self.spread_ms is None else self.spread_ms / count
        return Timing(self.ms / count, spread, self.work_ms / count, self.repeats)

    def ratio_to(self, reference: Timing) -> Ratio:
        """Divide this timing by that of a reference."""
        return Ratio(self.ms / reference.ms, self.work_ms / reference.work_ms if reference.work_ms else None)


def time_alternately(
    tasks: Mapping[str, Callable[[], Any]], repeats: int, clock: Clock | None = None
) -> tuple[dict[str, Timing], dict[str, Any]]:
    """Time tasks against each other: run each once unmeasured, then measure them in turns.

    A task is not measured again once its measured runs add up to MAX_SECONDS_PER_TASK. If the first run took that
    long, it counts as the measurement. At the start of each turn, a task that takes less than WARM_UP_SECONDS is run
    unmeasured for that long. The reason is that a slower task before it leaves cold caches and all threads on one core.

    Args:
        tasks: the tasks by name.
        repeats: turns of each task; at least 1.
        clock: runs and times a task; None measures wall and processor time. A clock that is passed does its own
            warm-up.

    Returns:
        The timing of each task by name, and the result of its first run by name.
    """
    results: dict[str, Any] = {}
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in tasks}
    short_tasks, measure = set(), clock or _measure
    for name, task in tasks.items():
        results[name], wall, work = measure(task)
        if wall >= MAX_SECONDS_PER_TASK:
            times[name].append((wall, work))
        elif wall < WARM_UP_SECONDS and clock is None:
            short_tasks.add(name)
    for _ in range(repeats):
        for name, task in tasks.items():
            if sum(wall for wall, _ in times[name]) < MAX_SECONDS_PER_TASK:
                end = perf_counter() + WARM_UP_SECONDS
                while name in short_tasks and perf_counter() < end:
                    task()
                _, wall, work = measure(task)
                times[name].append((wall, work))
    return {name: _summarise(measured) for name, measured in times.items()}, results


def _measure(task: Callable[[], Any]) -> tuple[Any, float, float]:
    """Run a task; return its result, and its wall time and processor time in seconds."""
    wall, work = perf_counter(), process_time()
    result = task()
    return result, perf_counter() - wall, process_time() - work


def _summarise(seconds: list[tuple[float, float]]) -> Timing:
    """Summarise (wall, processor) times of the repeats."""
    wall, work = 1e3 * np.array(seconds).T
    low, high = np.percentile(wall, (25, 75))
    return Timing(
        ms=float(np.median(wall)),
        spread_ms=float(high - low) if len(wall) > 1 else None,
        work_ms=float(np.median(work)),
        repeats=len(wall),
    )

"""Fair times on a machine that is not quiet: medians over repeats that take turns."""

from __future__ import annotations

import time
from collections.abc import Callable
from statistics import median


def interleaved_medians(tasks: dict[str, Callable[[], object]], repeats: int) -> dict[str, float]:
    """Milliseconds of each task: each runs once unmeasured, then all take turns `repeats` times."""
    for task in tasks.values():
        task()
    times: dict[str, list[float]] = {name: [] for name in tasks}
    for _ in range(repeats):
        for name, task in tasks.items():
            start = time.perf_counter()
            task()
            times[name].append(1000 * (time.perf_counter() - start))
    return {name: median(values) for name, values in times.items()}

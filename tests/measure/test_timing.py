from __future__ import annotations

import pytest

from hyrfpack.measure import timing
from hyrfpack.measure.timing import Timing, time_alternately


class Clock:
    """A clock that only tasks advance, by their seconds of wall time and twice as many of processor time."""

    def __init__(self, monkeypatch):
        self.now, self.calls = 0.0, []
        monkeypatch.setattr(timing, "perf_counter", lambda: self.now)
        monkeypatch.setattr(timing, "process_time", lambda: 2 * self.now)

    def task(self, name, seconds):
        durations = iter(seconds)

        def run():
            self.calls.append(name)
            self.now += next(durations)
            return name, len(self.calls)

        return run


def test_tasks_alternate_after_one_unmeasured_run_each(monkeypatch):
    clock = Clock(monkeypatch)
    _, results = time_alternately({"a": clock.task("a", [0.1] * 4), "b": clock.task("b", [0.1] * 4)}, 3)
    assert clock.calls == list("abababab")
    assert results == {"a": ("a", 1), "b": ("b", 2)}


def test_median_and_interquartile_range_are_of_the_measured_runs_alone(monkeypatch):
    clock = Clock(monkeypatch)
    timings, _ = time_alternately({"a": clock.task("a", [2.0, 0.001, 0.002, 0.003, 0.004, 0.100])}, 5)
    assert timings["a"].ms == pytest.approx(3) and timings["a"].spread_ms == pytest.approx(4 - 2)
    assert timings["a"].work_ms == pytest.approx(6) and timings["a"].repeats == 5


def test_a_task_that_takes_long_enough_leaves_the_round(monkeypatch):
    clock = Clock(monkeypatch)
    tasks = {"slow": clock.task("slow", [1.6] * 9), "fast": clock.task("fast", [0.2] * 9)}
    timings, _ = time_alternately(tasks, 6)
    assert (timings["slow"].repeats, timings["fast"].repeats) == (2, 6)


def test_a_quick_task_is_warmed_up_before_each_of_its_turns(monkeypatch):
    monkeypatch.setattr(timing, "WARM_UP_SECONDS", 0.1)
    clock = Clock(monkeypatch)
    warm = [0.03, 0.03, 0.03, 0.03]  # the fourth run begins before 0.1 s have passed
    tasks = {"slow": clock.task("slow", [0.1] * 3), "quick": clock.task("quick", [0.05, *warm, 0.02, *warm, 0.01])}
    timings, _ = time_alternately(tasks, 2)
    assert clock.calls == ["slow", "quick", "slow", *["quick"] * 5, "slow", *["quick"] * 5]
    assert timings["quick"].ms == pytest.approx(15) and timings["quick"].repeats == 2


def test_a_task_too_slow_to_repeat_is_timed_by_its_first_run(monkeypatch):
    clock = Clock(monkeypatch)
    timings, results = time_alternately({"slow": clock.task("slow", [5.0])}, 7)
    assert clock.calls == ["slow"] and results["slow"] == ("slow", 1)
    assert timings["slow"] == Timing(5000, None, 10000, 1)


def test_ratio_and_share_of_a_time():
    time = Timing(ms=30, spread_ms=3, work_ms=60, repeats=2)
    assert time.per_part(3) == Timing(10, 1, 20, 2)
    ratio = time.ratio_to(Timing(10, 1, 15, 2))
    assert (ratio.wall, ratio.work) == (3, 4)
    assert time.ratio_to(Timing(10, 1, 0, 2)).work is None

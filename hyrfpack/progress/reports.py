"""Report functions of two arguments: the name of the current task, and the completed share of the whole work."""

from __future__ import annotations

from collections.abc import Callable
from threading import Lock
from typing import TypeVar

from hyrfpack.progress.events import REMAINING_SHARE_PER_ROUND, Progress, TaskEvent

Report = Callable[[str, float], None]
S = TypeVar("S")
T = TypeVar("T")


def report_to(progress: Progress) -> Report:
    """Return a report function that reports to `progress`."""
    return lambda doing, share: progress(TaskEvent(doing, share))


def no_report(doing: str, share: float) -> None:
    """Ignore a report, for callers that need none."""


def report_part(report: Report, start: float, end: float) -> Report:
    """Return a report function for a part of the work, which maps its shares 0 to 1 to `start` to `end` of the whole.

    Example:
        >>> report_part(lambda doing, share: print(doing, share), 0.5, 1.0)("measuring", 0.5)
        measuring 0.75
    """
    return lambda doing, share: report(doing, start + (end - start) * share)


def report_round(report: Report, number: int) -> Report:
    """Return a report function for one round of work that takes an unknown number of rounds."""
    return report_part(report, *(1 - (1 - REMAINING_SHARE_PER_ROUND) ** rounds for rounds in (number, number + 1)))


def report_each_call(function: Callable[[S], T], report: Report, doing: str, count: int) -> Callable[[S], T]:
    """Return a function that does the same as `function` and reports after each of `count` calls, from any thread."""
    lock, done = Lock(), 0

    def call_and_report(item: S) -> T:
        nonlocal done
        result = function(item)
        with lock:
            done += 1
            report(doing, done / count)
        return result

    return call_and_report

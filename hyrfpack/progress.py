"""Progress of long work, told in plain calls: what is being done, and which share of the whole work is done."""

from __future__ import annotations

from collections.abc import Callable
from threading import Lock
from typing import TypeVar

Report = Callable[[str, float], None]  # what is being done, and the share of the whole that is done, 0 to 1
S = TypeVar("S")
T = TypeVar("T")

ROUND_SHARE = 0.4  # of the work left, that each of a few rounds is taken to do


def no_report(doing: str, share: float) -> None:
    """Report nothing."""


def report_part(report: Report, start: float, end: float) -> Report:
    """Return the report of one part of the work, whose share 0 to 1 becomes `start` to `end` of the whole.

    Example:
        >>> report_part(lambda doing, share: print(doing, share), 0.5, 1.0)("measuring", 0.5)
        measuring 0.75
    """
    return lambda doing, share: report(doing, start + (end - start) * share)


def report_round(report: Report, number: int) -> Report:
    """Return the report of one round, counted from 0, of work that ends after a few rounds, nobody knows how many.

    Each round is taken to do ROUND_SHARE of what is left, so that the share grows and never reaches 1.
    """
    return report_part(report, *(1 - (1 - ROUND_SHARE) ** rounds for rounds in (number, number + 1)))


def reporting(function: Callable[[S], T], report: Report, doing: str, count: int) -> Callable[[S], T]:
    """Return a function that does the same and reports after each of `count` calls, which threads may share."""
    lock, done = Lock(), 0

    def called(item: S) -> T:
        nonlocal done
        result = function(item)
        with lock:
            done += 1
            report(doing, done / count)
        return result

    return called

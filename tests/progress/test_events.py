"""Events of parts of the work combine into those of the whole."""

from __future__ import annotations

import pytest

from hyrfpack.parallel.pool import parallel_map
from hyrfpack.progress import (
    Event,
    StepEvent,
    TaskEvent,
    count_calls,
    items_of_progress,
    part_of_progress,
    round_of_progress,
)


def test_nested_parts_report_their_share_of_the_whole():
    events: list[Event] = []
    inner = part_of_progress(part_of_progress(events.append, 0.5, 1.0), 0.2, 0.4)
    for share in (0, 0.5, 1):
        inner(TaskEvent("measuring", share))
    assert events == [TaskEvent("measuring", pytest.approx(share)) for share in (0.6, 0.65, 0.7)]


def test_events_without_a_share_pass_unchanged_through_parts():
    events: list[Event] = []
    given = [TaskEvent("reading photos", done=1, total=2), StepEvent(1, 2, 0.5, 0.1, 7)]
    for event in given:
        part_of_progress(events.append, 0.5, 1.0)(event)
    assert events == given


def test_shares_become_numbers_of_items():
    events: list[Event] = []
    for share in (0, 1 / 3, 1):
        items_of_progress(events.append, "scoring held-out photos", 3)(TaskEvent("scoring", share))
    assert events == [TaskEvent("scoring held-out photos", done=done, total=3) for done in (0, 1, 3)]


def test_progress_of_rounds_increases_and_stays_below_1():
    events: list[Event] = []
    for number in range(30):
        progress = round_of_progress(events.append, number)
        progress(TaskEvent("round", 0))
        progress(TaskEvent("round", 1))
    shares = [event.share for event in events]
    assert shares[0] == 0 and shares == sorted(shares) and shares[-1] < 1
    assert shares[1::2][:-1] == pytest.approx(shares[2::2])  # each begins where the previous one has ended


def test_calls_of_several_threads_are_counted_once_each():
    events: list[Event] = []
    assert parallel_map(count_calls(abs, events.append, "drawing", 5), [-1, -2, 3, 4, -5]) == [1, 2, 3, 4, 5]
    assert events == [TaskEvent("drawing", pytest.approx(count / 5)) for count in range(1, 6)]

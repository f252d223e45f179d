"""Progress reports of parts of the work combine into reports of the whole."""

from __future__ import annotations

import pytest

from hyrfpack.parallel.pool import parallel_map
from hyrfpack.progress import report_each_call, report_part, report_round


def test_nested_parts_report_their_share_of_the_whole():
    messages = []
    inner = report_part(report_part(lambda *said: messages.append(said), 0.5, 1.0), 0.2, 0.4)
    for share in (0, 0.5, 1):
        inner("measuring", share)
    assert messages == [("measuring", pytest.approx(value)) for value in (0.6, 0.65, 0.7)]


def test_progress_of_rounds_increases_and_stays_below_1():
    messages = []
    for number in range(30):
        report = report_round(lambda doing, share: messages.append(share), number)
        report("round", 0)
        report("round", 1)
    assert messages[0] == 0 and messages == sorted(messages) and messages[-1] < 1
    assert messages[1::2][:-1] == pytest.approx(messages[2::2])  # each begins where the previous one has ended


def test_calls_of_several_threads_are_counted_once_each():
    messages = []
    assert parallel_map(
        report_each_call(abs, lambda *said: messages.append(said), "drawing", 5), [-1, -2, 3, 4, -5]
    ) == [
        1,
        2,
        3,
        4,
        5,
    ]
    assert messages == [("drawing", pytest.approx(count / 5)) for count in range(1, 6)]

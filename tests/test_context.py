"""RunContext: whose progress is shown, and how a call is stopped."""

from __future__ import annotations

import pytest

from hyrfpack.context import RunContext
from hyrfpack.parallel.ranks import Ranks
from hyrfpack.progress import Event, TaskEvent, lines


def test_progress_that_is_neither_a_function_nor_auto_is_an_error():
    with pytest.raises(ValueError, match="progress must be 'auto', None or a function, but is True"):
        RunContext(progress=True)


@pytest.mark.parametrize("rank", [0, 1])
def test_of_several_processes_only_the_main_one_shows_progress(rank, capsys, monkeypatch):
    monkeypatch.setattr(lines, "LOG_INTERVAL_SECONDS", 0.0)
    context = RunContext(ranks=Ranks(rank=rank, size=2))
    with context.open_progress("compress") as progress:
        while not (rank or capsys.readouterr().err.startswith("compress | measuring | ")):
            progress(TaskEvent("measuring", 0.5))
        progress(TaskEvent("measuring", 1.0))
    assert rank == 0 or capsys.readouterr().err == ""
    assert context.is_shown == (rank == 0)


def test_a_function_gets_the_events_of_its_own_process():
    events: list[Event] = []
    with RunContext(ranks=Ranks(rank=1, size=2), progress=events.append).open_progress() as progress:
        progress(TaskEvent("measuring", 0.5))
    assert events == [TaskEvent("measuring", 0.5)]


def test_a_request_to_stop_interrupts_at_the_next_event():
    events: list[Event] = []
    context = RunContext(progress=events.append, stop=lambda: len(events) >= 2)
    with pytest.raises(KeyboardInterrupt), context.open_progress() as progress:
        for share in (0.1, 0.2, 0.3):
            progress(TaskEvent("measuring", share))
    assert len(events) == 2


def test_a_call_that_stops_by_itself_is_not_interrupted():
    with RunContext(progress=None, stop=lambda: True).open_progress(interruptible=False) as progress:
        progress(TaskEvent("measuring", 0.5))

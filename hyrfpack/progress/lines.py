"""Progress where standard error is not a terminal, as in a log file: a plain line now and then."""

from __future__ import annotations

import sys
from contextlib import suppress
from threading import Event as Flag
from threading import Lock, Thread
from time import monotonic

from hyrfpack.progress.events import Event, StepEvent, TaskEvent
from hyrfpack.progress.status import Status

LOG_INTERVAL_SECONDS = 15.0
# A task whose share of the whole is unknown gets its first line once it takes this long.
FIRST_TASK_LOG_SECONDS = 2.0
CHECK_INTERVAL_SECONDS = 0.25


class LineDisplay:
    """Prints the line of the current work on standard error every LOG_INTERVAL_SECONDS.

    The last step of a training run is always printed. If standard error is closed or its disk is full, the work
    continues.
    """

    def __init__(self, status: Status) -> None:
        self._status, self._printed, self._lock = status, status.start, Lock()
        self._over = Flag()
        self._thread = Thread(target=self._watch, daemon=True)

    def __enter__(self) -> LineDisplay:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()

    def __call__(self, event: Event) -> None:
        with self._lock:
            self._status.update(event)
            if isinstance(event, StepEvent):
                self._print_if_due()

    def _watch(self) -> None:
        """Print the lines of tasks and stages, which may take long without an event."""
        while not self._over.wait(CHECK_INTERVAL_SECONDS):
            with self._lock:
                if not isinstance(self._status.event, StepEvent):
                    self._print_if_due()

    def _print_if_due(self) -> None:
        now = monotonic()
        if self._is_due(now) and (line := self._status.line()):
            self._printed = now
            with suppress(OSError, ValueError):
                print(line, file=sys.stderr, flush=True)

    def _is_due(self, now: float) -> bool:
        event, begin = self._status.event, self._status.task_start
        if isinstance(event, StepEvent):
            return event.step == event.steps or now - max(self._printed, begin) >= LOG_INTERVAL_SECONDS
        if isinstance(event, TaskEvent) and event.share is None and self._printed <= begin:
            return now - begin >= FIRST_TASK_LOG_SECONDS
        return now - self._printed >= LOG_INTERVAL_SECONDS

"""Turn signals that ask a process to end into requests to stop after the current step."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

# These signals end a run early (Windows has no SIGHUP).
STOP_SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]


class TrainingStopped(Exception):
    """Raised if training is asked to stop in a run before the training itself."""


@contextmanager
def catch_stop_signals(stop: Callable[[], bool] | None = None) -> Iterator[Callable[[], bool]]:
    """Turn the first Ctrl-C, SIGTERM or SIGHUP into a request to stop; a second Ctrl-C or SIGTERM takes effect at once.

    Signals that the parent process ignores stay ignored: SIGHUP under nohup, Ctrl-C in the background of a script. A
    second SIGHUP has no effect, because closing a terminal sends two: one by the shell and one by the terminal. Blocks
    may be nested: a signal within the inner one is a request in both.

    Args:
        stop: returns whether something else than a signal has asked to stop.

    Yields:
        A function that returns whether a stop was requested.
    """
    # A threading.Event would hold its lock in `set`, and a second signal's handler would wait for that lock forever.
    is_signalled = False

    def is_requested() -> bool:
        return is_signalled or (stop is not None and stop())

    if threading.current_thread() is not threading.main_thread():  # Only the main thread can handle signals.
        yield is_requested
        return
    found = {number: signal.getsignal(number) for number in STOP_SIGNALS}
    previous = {number: handler for number, handler in found.items() if handler not in (signal.SIG_IGN, None)}

    def handle(number: int, frame: FrameType | None) -> None:
        nonlocal is_signalled
        is_signalled = True
        outer = previous[number]
        if getattr(outer, "is_request", False) and callable(outer):  # A stop that ends this block ends the outer one.
            outer(number, frame)
        elif number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, outer)

    handle.is_request = True  # type: ignore[attr-defined]

    try:
        for number in previous:
            signal.signal(number, handle)
        yield is_requested
    finally:
        for number, handler in previous.items():
            if signal.getsignal(number) is handle:  # Otherwise a request has restored what the next signal does.
                signal.signal(number, handler)

"""End a test process that hangs, also in compiled code, and print where each thread is."""

from __future__ import annotations

import faulthandler
import os
import time

MAX_TEST_SECONDS = 600.0
RENEWAL_SECONDS = 60.0


class HangWatchdog:
    """Plugin of pytest that ends the process if a test takes longer than `max_seconds`, up to `renewal_seconds` more.

    pytest-timeout and pytest's own `faulthandler_timeout` start and join a thread for each test, which takes about 8 %
    of the time of short tests. This one starts a thread every `renewal_seconds` at most.
    """

    def __init__(self, max_seconds: float = MAX_TEST_SECONDS, renewal_seconds: float = RENEWAL_SECONDS) -> None:
        self._max_seconds, self._renewal_seconds = max_seconds, renewal_seconds
        self._stderr = os.dup(2)  # pytest captures what tests write to the descriptor 2
        self._next_renewal = time.monotonic()

    def pytest_runtest_setup(self) -> None:
        now = time.monotonic()
        if now >= self._next_renewal:
            self._next_renewal = now + self._renewal_seconds
            seconds = self._max_seconds + self._renewal_seconds
            faulthandler.dump_traceback_later(seconds, exit=True, file=self._stderr)

    def pytest_unconfigure(self) -> None:
        faulthandler.cancel_dump_traceback_later()
        os.close(self._stderr)

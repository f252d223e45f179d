"""Run another program for at most some seconds, and keep what it prints in a file, line by line."""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from threading import Timer

REPOSITORY_ROOT = Path(__file__).parents[2]
SECONDS_TO_END = 8.0


class TimedProcess:
    """A program that is interrupted after its time limit, and killed if it has not ended SECONDS_TO_END later.

    Signals go to the processes that it has started, too, which would else hold its output open.

    Attributes:
        is_out_of_time: whether it was interrupted.
        exit_code: its exit code, once all lines were read.
    """

    def __init__(
        self, command: Sequence[str], seconds: float, log: Path | None, environment: Mapping[str, str] = os.environ
    ) -> None:
        """Start the program in the repository's root.

        Args:
            command: the program and its arguments.
            seconds: time limit.
            log: file for its output and errors; None for no file.
            environment: its environment.
        """
        self.is_out_of_time, self.exit_code = False, 0
        self._log = log
        self._process = subprocess.Popen(
            list(command),
            cwd=REPOSITORY_ROOT,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            env=dict(environment),
            start_new_session=True,
        )
        self._timers = [Timer(seconds, self._interrupt), Timer(seconds + SECONDS_TO_END, self._kill)]
        for timer in self._timers:
            timer.daemon = True
            timer.start()

    def lines(self) -> Iterator[str]:
        """Yield the lines of output and errors until the program ends."""
        if self._log is not None:
            self._log.parent.mkdir(parents=True, exist_ok=True)
        assert self._process.stdout is not None
        try:
            with open(self._log or os.devnull, "w", buffering=1) as log:
                for line in self._process.stdout:
                    log.write(line)
                    yield line
            self.exit_code = self._process.wait()
        finally:
            for timer in self._timers:
                timer.cancel()
            self._kill()  # Without a terminal of its own, the program is not interrupted with its caller.
            self._process.wait()

    def _interrupt(self) -> None:
        self.is_out_of_time = True
        self._send_signal(signal.SIGINT)

    def _kill(self) -> None:
        self._send_signal(signal.SIGKILL)

    def _send_signal(self, number: signal.Signals) -> None:
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(self._process.pid, number)

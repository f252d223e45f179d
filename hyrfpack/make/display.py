"""One display for all stages: on a terminal one line, elsewhere a plain line every few seconds."""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextlib import suppress
from threading import Event, Thread
from time import monotonic

from rich.console import Console, ConsoleOptions, RenderResult
from rich.live import Live

from hyrfpack.make.progress import OVERDUE_RATIO, Progress
from hyrfpack.train.progress import LOG_INTERVAL_SECONDS, StatusLine, duration


class Display:
    """Shows stage, share, what the stage has to say, and the time gone and left on standard error.

    The clock runs on between two reports, because some stages cannot tell how far they are. When the time that was
    left at the last report is over, the time left grows with the silence. A standard error that goes away does not end
    the work.
    """

    def __init__(self, wording: Callable[[str], str] = lambda sentence: sentence) -> None:
        """Args: wording: changes the words of each sentence before it is shown."""
        self._wording = wording
        self._start = monotonic()
        self._latest: tuple[Progress, float] | None = None
        self._over = Event()
        self._live: Live | None = None
        if sys.stderr.isatty() and not (console := Console(stderr=True)).is_dumb_terminal:
            self._live = Live(self, console=console, refresh_per_second=4, transient=True)
        self._lines = Thread(target=self._log, daemon=True)

    def __enter__(self) -> Display:
        if self._live:
            with suppress(OSError, ValueError):
                self._live.start(refresh=True)
        else:
            self._lines.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        if self._live:
            with suppress(OSError, ValueError):
                self._live.stop()
        else:
            self._lines.join()

    def show(self, progress: Progress) -> None:
        """Take in how far the work is."""
        self._latest = progress, monotonic()

    def say(self, sentence: str) -> None:
        """Tell the person something that stays."""
        sentence = self._wording(sentence)
        with suppress(OSError, ValueError):
            if self._live:
                self._live.console.print(sentence, markup=False, highlight=False, soft_wrap=True)
            else:
                print(sentence, file=sys.stderr, flush=True)

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        parts = self._parts()
        if parts and self._latest:
            droppable = [name for name in reversed(parts) if name not in ("stage", "left")]
            yield StatusLine(parts, self._latest[0].share, (*droppable, "left"))

    def _parts(self) -> dict[str, str]:
        """What is known, by name in the order of reading."""
        if self._latest is None:
            return {}
        (progress, at), now = self._latest, monotonic()
        words = {f"word {number}": word for number, word in enumerate(progress.words)}
        parts = {
            "stage": f"{progress.place}/{progress.of} {progress.stage}",
            **words,
            "gone": f"{duration(now - self._start)} gone",
        }
        if progress.left is not None:
            silent = now - at
            left = max(progress.left - silent, OVERDUE_RATIO * silent, 1.0)
            parts["left"] = f"about {duration(left)} left"
        return parts

    def _log(self) -> None:
        while not self._over.wait(LOG_INTERVAL_SECONDS):
            if parts := self._parts():
                self.say("  ".join(parts.values()))

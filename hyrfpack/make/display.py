"""Show the progress of all stages: as one live line on a terminal, elsewhere as a plain line every few seconds."""

from __future__ import annotations

import sys
from contextlib import suppress
from threading import Event, Thread
from time import monotonic

from rich.console import Console, ConsoleOptions, RenderResult
from rich.live import Live

from hyrfpack.make.progress import OVERDUE_TIME_RATIO, Progress
from hyrfpack.train.progress import LOG_INTERVAL_SECONDS, PART_SEPARATOR, StatusLine, format_elapsed, format_eta


class Display:
    """Shows the stage, its share and descriptions, the elapsed and the estimated remaining time on standard error.

    The elapsed time is kept current between two reports, because some stages do not know their progress. When the
    remaining time of the last report is over, the estimate grows with the time since that report. What is printed to
    standard error meanwhile appears above the line. If standard error is closed, the work continues.
    """

    def __init__(self) -> None:
        self._start = monotonic()
        self._latest: tuple[Progress, float] | None = None
        self._stopped = Event()
        self._live: Live | None = None
        if sys.stderr.isatty() and not (console := Console(stderr=True, soft_wrap=True)).is_dumb_terminal:
            self._live = Live(self, console=console, refresh_per_second=4, transient=True)
        self._log_thread = Thread(target=self._print_lines, daemon=True)

    def __enter__(self) -> Display:
        if self._live:
            with suppress(OSError, ValueError):
                self._live.start(refresh=True)
        else:
            self._log_thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopped.set()
        if self._live:
            with suppress(OSError, ValueError):
                self._live.stop()
        else:
            self._log_thread.join()

    def show(self, progress: Progress) -> None:
        """Show this progress from now on."""
        self._latest = progress, monotonic()

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        parts = self._parts()
        if parts and self._latest:
            droppable = [name for name in reversed(parts) if name not in ("stage", "eta")]
            yield StatusLine(parts, self._latest[0].share, (*droppable, "eta"))

    def _parts(self) -> dict[str, str]:
        """Return the texts of the line by name, in reading order."""
        if self._latest is None:
            return {}
        (progress, at), now = self._latest, monotonic()
        words = {f"word {number}": word for number, word in enumerate(progress.words)}
        number = f"{progress.place}/{progress.of} " if progress.of > 1 else ""
        parts = {
            "stage": f"{number}{progress.stage}",
            **words,
            "elapsed": format_elapsed(now - self._start),
        }
        if progress.left is not None:
            seconds_since_report = now - at
            left = max(progress.left - seconds_since_report, OVERDUE_TIME_RATIO * seconds_since_report, 1.0)
            parts["eta"] = format_eta(left)
        return parts

    def _print_lines(self) -> None:
        """Print the current line every few seconds until the display is closed."""
        while not self._stopped.wait(LOG_INTERVAL_SECONDS):
            if parts := self._parts():
                with suppress(OSError, ValueError):
                    print(PART_SEPARATOR.join(parts.values()), file=sys.stderr, flush=True)

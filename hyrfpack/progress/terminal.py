"""Progress on a terminal: one line that is redrawn and fits any width."""

from __future__ import annotations

import sys
from contextlib import suppress

from rich.console import Console, ConsoleOptions, RenderResult
from rich.live import Live
from rich.text import Text

from hyrfpack.progress.display import is_terminal
from hyrfpack.progress.events import Event, StepEvent
from hyrfpack.progress.status import PART_SEPARATOR, Status, StatusLine

REFRESHES_PER_SECOND = 4
MIN_BAR_COLUMNS, MAX_BAR_COLUMNS = 8, 24


class TerminalDisplay:
    """Redraws one line on standard error, also between two events.

    What is printed to a terminal meanwhile appears above the line; what is printed to a file or a pipe goes there. The
    line of the last step of a training run stays, others are removed at the end. If standard error is closed, the work
    continues.
    """

    def __init__(self, status: Status) -> None:
        self._status = status
        # A terminal wraps long messages itself, so that a path in them can be copied.
        console = Console(stderr=True, soft_wrap=True)
        self._live = Live(
            self,
            console=console,
            refresh_per_second=REFRESHES_PER_SECOND,
            transient=True,
            redirect_stdout=is_terminal(sys.stdout),
        )

    def __enter__(self) -> TerminalDisplay:
        with suppress(OSError, ValueError):
            self._live.start(refresh=True)
        return self

    def __exit__(self, *_: object) -> None:
        self._live.transient = not isinstance(self._status.event, StepEvent)
        with suppress(OSError, ValueError):
            self._live.stop()

    def __call__(self, event: Event) -> None:
        if isinstance(self._status.event, StepEvent) and not isinstance(event, StepEvent):
            with suppress(OSError, ValueError):
                self._live.console.print(self)
        self._status.update(event)

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        if line := self._status.line():
            yield FittedLine(line)


class FittedLine:
    """A line with the parts that fit the terminal, and a bar if there is room for one."""

    def __init__(self, line: StatusLine) -> None:
        self._line = line

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        parts, width = dict(self._line.parts), options.max_width
        for name in self._line.optional:
            if len(PART_SEPARATOR.join(parts.values())) > width:
                parts.pop(name, None)
        first, *others = parts.values()
        text = Text(first, no_wrap=True, overflow="crop")
        room = min(width - len(PART_SEPARATOR.join(parts.values())) - 1, MAX_BAR_COLUMNS)
        if room >= MIN_BAR_COLUMNS:
            done, mark = round(self._line.share * room), "-" if options.ascii_only else "\u2501"
            text.append(" ").append(mark * done, "bar.complete").append(mark * (room - done), "bar.back")
        yield text.append("".join(f"{PART_SEPARATOR}{part}" for part in others))

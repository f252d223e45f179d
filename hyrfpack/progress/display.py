"""Choose the display of a call's progress: a notebook's, a terminal's, or plain lines."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from importlib.util import find_spec
from typing import Any, Literal, TextIO

from hyrfpack.progress.events import Progress, ignore_progress
from hyrfpack.progress.status import Status


@contextmanager
def open_display(progress: Progress | Literal["auto"] | None = "auto", title: str = "") -> Iterator[Progress]:
    """Show progress while the block runs, and yield the function that takes its events.

    Args:
        progress: "auto" for a bar and curves in Jupyter, one line that is redrawn on a terminal, and plain lines on
            standard error elsewhere; None to show nothing; or the function itself.
        title: name of the work, which begins the lines of its tasks.

    Example:
        >>> from hyrfpack.progress import TaskEvent
        >>> with open_display(print) as progress:
        ...     progress(TaskEvent("scoring held-out photos", done=3, total=20))
        scoring held-out photos 3/20
    """
    if progress == "auto":
        with _choose_display(Status(title)) as display:
            yield display
    else:
        yield progress or ignore_progress


def _choose_display(status: Status) -> Any:
    """Return the display, a context manager, that suits this process."""
    if _is_in_notebook():
        from hyrfpack.progress.notebook import NotebookDisplay

        return NotebookDisplay(status)
    if sys.stderr is None:
        return nullcontext(ignore_progress)
    if _can_redraw():
        from hyrfpack.progress.terminal import TerminalDisplay

        return TerminalDisplay(status)
    from hyrfpack.progress.lines import LineDisplay

    return LineDisplay(status)


def _is_in_notebook() -> bool:
    """Return whether this process is a kernel of Jupyter that can display HTML."""
    if "IPython" not in sys.modules:
        return False
    try:
        import IPython.display
    except ImportError:
        return False
    return getattr(IPython.get_ipython(), "kernel", None) is not None


def _can_redraw() -> bool:
    """Return whether standard error is a terminal that can redraw a line, and rich, which draws it, is installed."""
    if find_spec("rich") is None or not is_terminal(sys.stderr):
        return False
    return os.environ.get("TERM", "").lower() not in ("dumb", "unknown")


def is_terminal(stream: TextIO | None) -> bool:
    """Return whether a standard stream is a terminal; it is None for a process that has none."""
    try:
        return stream is not None and stream.isatty()
    except ValueError:  # It is closed.
        return False

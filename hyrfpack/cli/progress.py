"""How commands show that long work goes on."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from hyrfpack.cli.wording import with_options

if TYPE_CHECKING:
    from hyrfpack.make.display import Display
    from hyrfpack.progress import Report


def command_display() -> Display:
    """Return the display of a command, which names options where library sentences name Python arguments."""
    from hyrfpack.make.display import Display

    return Display(with_options)


@contextmanager
def shown_progress(command: str) -> Iterator[Report]:
    """Show the progress of a command on standard error: what it is doing, the time gone and the time left.

    Yields:
        What the work reports to. Sentences printed meanwhile appear above the line.
    """
    from hyrfpack.make.progress import Reporter

    with command_display() as display:
        reporter = Reporter([command], display.show)
        reporter.begin(command)
        yield lambda doing, share: reporter.update(share, doing)

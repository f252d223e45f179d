"""Progress of long commands on standard error."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from hyrfpack.cli.wording import use_option_names

if TYPE_CHECKING:
    from hyrfpack.make.display import Display
    from hyrfpack.progress import Report


def create_command_display() -> Display:
    """Return a progress display that names options where messages of the library name Python arguments."""
    from hyrfpack.make.display import Display

    return Display(use_option_names)


@contextmanager
def show_progress(command: str) -> Iterator[Report]:
    """Show the progress of a command on standard error: what it is doing, elapsed time and remaining time.

    Yields:
        The function that the work reports its progress to. Sentences printed meanwhile appear above the line.
    """
    from hyrfpack.make.progress import Reporter

    with create_command_display() as display:
        reporter = Reporter([command], display.show)
        reporter.begin(command)
        yield lambda doing, share: reporter.update(share, doing)

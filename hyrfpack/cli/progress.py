"""Progress of long commands on standard error."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from hyrfpack.progress import Progress

T = TypeVar("T")


@contextmanager
def show_progress(command: str) -> Iterator[Progress]:
    """Show the progress of a command on standard error: what it is doing, elapsed time and remaining time.

    Yields:
        The function that the work reports its progress to. Sentences printed meanwhile appear above the line.
    """
    from hyrfpack.progress import open_display

    with open_display("auto", command) as progress:
        yield progress


def show_item_progress(items: Iterable[T], count: int, command: str, noun: str) -> Iterator[T]:
    """Yield the items and show on standard error how many of them are done.

    Args:
        items: the items, each of which takes a while.
        count: number of items.
        command: name of the command.
        noun: noun for one item, such as "picture".
    """
    from hyrfpack.progress import TaskEvent

    with show_progress(command) as progress:
        for done, item in enumerate(items, start=1):
            progress(TaskEvent(f"{noun} {done}/{count}", done / count))
            yield item

"""Progress of long commands on standard error."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import TypeVar

T = TypeVar("T")


def show_item_progress(items: Iterable[T], count: int, command: str, noun: str) -> Iterator[T]:
    """Yield the items and show on standard error how many of them are done.

    Args:
        items: the items, each of which takes a while.
        count: number of items.
        command: name of the command.
        noun: noun for one item, such as "picture".
    """
    from hyrfpack.progress import TaskEvent, open_display

    with open_display("auto", command) as progress:
        for number, item in enumerate(items, start=1):
            progress(TaskEvent(f"{noun} {number}/{count}", number / count))
            yield item

"""The options --view and --view-port of commands that train a model."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, TypeVar

import click

if TYPE_CHECKING:
    from hyrfpack.train import Trainer

Command = TypeVar("Command", bound=Callable)


def view_options(command: Command) -> Command:
    """Add the options that show the training in a browser: --view, --view-port."""
    with_options: Any = command
    for option in (
        click.option(
            "--view-port",
            type=click.IntRange(0, 65535),
            metavar="PORT",
            help="Port for --view.  [default: a free port]",
        ),
        click.option("--view", is_flag=True, help="Serve a page that shows the model during training."),
    ):
        with_options = option(with_options)
    return with_options


def check_view_options(view: bool, view_port: int | None) -> None:
    """Raise UsageError if --view-port is given without --view."""
    if view_port is not None and not view:
        raise click.UsageError("--view-port is the port of --view; give both of them")


@contextmanager
def serve_training_view(title: str, view: bool, view_port: int | None) -> Iterator[Callable[[Trainer], None] | None]:
    """Serve a page that shows the training, if --view asks for it, while the block runs.

    Yields:
        The observer of the training that updates the page; None without --view.

    Args:
        title: title of the page.
        view, view_port: values of the options.

    Raises:
        UsageError: --view-port is given without --view.
        HyrfError: nothing can listen at this port.
    """
    check_view_options(view, view_port)
    if not view:
        yield None
        return
    from hyrfpack.live import live_view

    with live_view(title, port=view_port or 0) as live:
        yield live.observe

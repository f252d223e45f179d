"""--processes: commands that several processes carry out together, and what only one of them says."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from typing import Any, TypeVar

import click

from hyrfpack.cli.manners import arguments_of, note
from hyrfpack.errors import HyrfError

Command = TypeVar("Command", bound=Callable)

OPTION = "--processes"


def on_processes(command: Command) -> Command:
    """Give a command --processes, and let it run on those that torchrun or srun has started, which it gets as `ranks`.

    Rank 0 alone speaks.
    """

    @functools.wraps(command)
    def together(*args: Any, processes: int | None, **options: Any) -> Any:
        from hyrfpack.parallel.ranks import join_processes, ranks_from_environment

        started = ranks_from_environment(os.environ)
        if processes is not None and not started.is_single:
            with _heard(started.is_main):
                raise click.UsageError(f"torchrun or srun has started {started.size} processes; leave out {OPTION}")
        if processes is not None and processes > 1:
            from hyrfpack.parallel.launch import launch

            ctx = click.get_current_context()
            ctx.exit(launch(without(arguments_of(ctx)), processes, note))
        with join_processes() as ranks, _heard(ranks.is_main):
            return command(*args, ranks=ranks, **options)

    with_option: Any = together
    option = click.option(
        OPTION,
        type=click.IntRange(1, 1024),
        metavar="N",
        help="Share the work among N processes of this machine, one a GPU; torchrun starts them on several.",
    )
    return option(with_option)


@contextmanager
def _heard(leads: bool) -> Iterator[None]:
    """Say nothing where rank 0 says it."""
    if leads:
        yield
        return
    try:
        with open(os.devnull, "w", encoding="utf-8") as nowhere, redirect_stdout(nowhere), redirect_stderr(nowhere):
            yield
    except (HyrfError, click.UsageError):
        click.get_current_context().exit(2)


def without(arguments: Sequence[str], option: str = OPTION) -> list[str]:
    """Arguments less an option and its value.

    Example:
        >>> without(["train", "photos", "--processes", "2", "--steps", "9"])
        ['train', 'photos', '--steps', '9']
    """
    left, words = [], iter(arguments)
    for word in words:
        if word == option:
            next(words, None)
        elif not word.startswith(f"{option}="):
            left.append(word)
    return left

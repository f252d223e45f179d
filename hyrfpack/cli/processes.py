"""The option --processes of commands that several processes carry out together, of which only rank 0 prints."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from typing import Any, TypeVar

import click

from hyrfpack.cli.console import stored_arguments
from hyrfpack.errors import HyrfError

Command = TypeVar("Command", bound=Callable)

PROCESSES_OPTION = "--processes"


def processes_option(command: Command) -> Command:
    """Add the option --processes to a command, and let it run in several processes.

    The option starts the processes, unless torchrun or srun has started them. The command gets them as the argument
    `ranks`. Only rank 0 prints.
    """

    @functools.wraps(command)
    def run_in_group(*args: Any, processes: int | None, **options: Any) -> Any:
        from hyrfpack.parallel.ranks import join_processes, ranks_from_environment

        started = ranks_from_environment(os.environ)
        if processes is not None and not started.is_single:
            with _silence_unless(started.is_main):
                raise click.UsageError(
                    f"torchrun or srun has started {started.size} processes; leave out {PROCESSES_OPTION}"
                )
        if processes is not None and processes > 1:
            from hyrfpack.parallel.launch import launch

            ctx = click.get_current_context()
            ctx.exit(launch(remove_processes_option(stored_arguments(ctx)), processes))
        with join_processes() as ranks, _silence_unless(ranks.is_main):
            return command(*args, ranks=ranks, **options)

    with_option: Any = run_in_group
    option = click.option(
        PROCESSES_OPTION,
        type=click.IntRange(1, 1024),
        metavar="N",
        help="Share the work among N processes on this machine, one per GPU. For several machines, use torchrun.",
    )
    return option(with_option)


@contextmanager
def _silence_unless(is_main: bool) -> Iterator[None]:
    """Suppress all output in the block unless this is the main process, which prints the same."""
    if is_main:
        yield
        return
    try:
        with open(os.devnull, "w", encoding="utf-8") as nowhere, redirect_stdout(nowhere), redirect_stderr(nowhere):
            yield
    except (HyrfError, click.UsageError):
        click.get_current_context().exit(2)


def remove_processes_option(arguments: Sequence[str]) -> list[str]:
    """Return arguments without --processes and its value.

    Example:
        >>> remove_processes_option(["train", "photos", "--processes", "2", "--steps", "9"])
        ['train', 'photos', '--steps', '9']
    """
    kept_words, words = [], iter(arguments)
    for word in words:
        if word == PROCESSES_OPTION:
            next(words, None)
        elif not word.startswith(f"{PROCESSES_OPTION}="):
            kept_words.append(word)
    return kept_words

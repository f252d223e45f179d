"""Turns Python arguments that library messages name into the options of the command line."""

from __future__ import annotations

import re
from collections.abc import Iterable

import click

# Library messages write an argument in backticks, with or without a value: `data`, `overwrite=True`, `max_size=0`.
_ARGUMENT = re.compile(r"`([a-z_0-9]+)(?:=([^`]+))?`")
_QUOTE = "'"  # around a value that is a word
# Arguments whose option is not the argument's name with dashes.
_OPTION_OF_ARGUMENT = {"degree": "--sh-degree", "finetune_steps": "--finetune", "target_bytes": "--target-size"}


def with_options(message: str) -> str:
    """Replace each Python argument in a message by the option that the person can type.

    An argument that is True or False becomes the bare flag that sets it, any other value follows its option. What
    names no option of any command stays as it is.

    Example:
        >>> with_options("out.hyrf: the file exists; replace it with `overwrite=True`")
        'out.hyrf: the file exists; replace it with --overwrite'
        >>> with_options("show all pixels with `max_size=0`, or leave out the sky with `background=False`")
        'show all pixels with --max-size 0, or leave out the sky with --no-background'
    """
    return _ARGUMENT.sub(_option, message)


def _option(match: re.Match[str]) -> str:
    name, value = match[1], match[2]
    flag = _OPTION_OF_ARGUMENT.get(name, f"--{name.replace('_', '-')}")
    option = next((option for option in _all_options() if flag in option.opts), None)
    if option is None:
        return match[0]
    if value is None or value == "True":
        return flag
    if value == "False":
        return next(iter(option.secondary_opts), match[0])
    return f"{flag} {value.strip(_QUOTE)}"


def _all_options() -> Iterable[click.Option]:
    """The options of every command."""
    from hyrfpack.cli import main

    for command in main.commands.values():
        yield from (parameter for parameter in command.params if isinstance(parameter, click.Option))

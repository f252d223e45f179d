"""Replacement of the Python arguments that messages of the library name by options of the command line."""

from __future__ import annotations

import re
from collections.abc import Iterable

import click

# Messages of the library write an argument in backticks, with or without a value: `data`, `overwrite=True`.
_ARGUMENT_PATTERN = re.compile(r"`([a-z_0-9]+)(?:=([^`]+))?`")
_WORD_QUOTE = "'"  # Python writes it around a value that is a word
# Arguments whose option is not the argument's name with dashes.
_OPTION_OF_ARGUMENT = {"degree": "--sh-degree", "finetune_steps": "--finetune", "target_bytes": "--target-size"}


def use_option_names(message: str) -> str:
    """Replace each Python argument in a message by the option that the user can type.

    An argument that is True or False becomes the flag that sets it; any other value follows its option. An argument
    that is no option of any command stays.

    Example:
        >>> use_option_names("out.hyrf: the file exists; replace it with `overwrite=True`")
        'out.hyrf: the file exists; replace it with --overwrite'
        >>> use_option_names("show all pixels with `max_size=0`, or leave out the sky with `background=False`")
        'show all pixels with --max-size 0, or leave out the sky with --no-background'
    """
    return _ARGUMENT_PATTERN.sub(_replacement, message)


def _replacement(match: re.Match[str]) -> str:
    """Return the option for an argument that the pattern has found, or the argument itself."""
    name, value = match[1], match[2]
    flag = _OPTION_OF_ARGUMENT.get(name, f"--{name.replace('_', '-')}")
    option = next((option for option in _all_options() if flag in option.opts), None)
    if option is None:
        return match[0]
    if value is None or value == "True":
        return flag
    if value == "False":
        return next(iter(option.secondary_opts), match[0])
    return f"{flag} {value.strip(_WORD_QUOTE)}"


def _all_options() -> Iterable[click.Option]:
    """Yield the options of every command."""
    from hyrfpack.cli import main

    for command in main.commands.values():
        yield from (parameter for parameter in command.params if isinstance(parameter, click.Option))

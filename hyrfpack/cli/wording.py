"""Replacement of the Python arguments that messages of the library name by options of the command line."""

from __future__ import annotations

import re

# Messages of the library write an argument in backticks, with or without a value: `data`, `overwrite=True`.
_ARGUMENT_PATTERN = re.compile(r"`([a-z_0-9]+)(?:=([^`]+))?`")
_WORD_QUOTE = "'"  # Python writes it around a value that is a word
# Arguments whose option is not the argument's name with dashes.
_OPTION_OF_ARGUMENT = {
    "degree": "--sh-degree",
    "finetune_steps": "--finetune",
    "observer": "--view",
    "target_bytes": "--target-size",
    "tiles_3d": "--3d-tiles",
}


def use_option_names(message: str) -> str:
    """Replace each Python argument in a message by the option that the user can type.

    An argument that is True or False becomes the flag that sets it; any other value follows its option.

    Example:
        >>> use_option_names("out.hyrf: the file exists; replace it with `overwrite=True`")
        'out.hyrf: the file exists; replace it with --overwrite'
        >>> use_option_names("show all pixels with `max_size=0`, or leave out the sky with `background=False`")
        'show all pixels with --max-size 0, or leave out the sky with --no-background'
    """
    return _ARGUMENT_PATTERN.sub(_option, message)


def option_of_argument(name: str) -> str:
    """Return the option that sets a Python argument.

    Example:
        >>> option_of_argument("target_bytes"), option_of_argument("max_gaussians")
        ('--target-size', '--max-gaussians')
    """
    return _OPTION_OF_ARGUMENT.get(name, f"--{name.replace('_', '-')}")


def _option(match: re.Match[str]) -> str:
    """Return the option for an argument that the pattern has found."""
    value, option = match[2], option_of_argument(match[1])
    if value is None or value == "True":
        return option
    if value == "False":
        return option.replace("--", "--no-", 1)
    return f"{option} {value.strip(_WORD_QUOTE)}"

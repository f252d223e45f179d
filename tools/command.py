"""Parse and run the command lines of tools."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from typing import NoReturn

from hyrfpack.cli.wording import use_option_names
from hyrfpack.errors import HyrfError


def positive_integer(text: str) -> int:
    """Return an integer of at least 1; argparse reports other texts. A check of nothing would always pass.

    Raises:
        ArgumentTypeError: the text is no such number.
    """
    if text.strip().isdecimal() and (number := int(text)) > 0:
        return number
    raise argparse.ArgumentTypeError(f"'{text}' is not an integer of at least 1")


def run_command(main: Callable[[], int | None]) -> NoReturn:
    """Run `main` and exit with its code; after an error that the user can correct, print one line and exit with 2."""
    try:
        sys.exit(main())
    except HyrfError as error:
        print(f"error: {error.problem}; {use_option_names(error.fix)}", file=sys.stderr)
        sys.exit(2)

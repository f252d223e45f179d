"""Parse and run the command lines of tools."""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Callable, Sequence
from typing import Any, NoReturn

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


def read_child_json(module: str, arguments: Sequence[object]) -> Any:
    """Run a module in a process of its own; return the JSON value in the last line of its output.

    Raises:
        HyrfError: the process has failed. Its messages went to the standard error of this one.
    """
    command = [sys.executable, "-m", module, *map(str, arguments)]
    process = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
    if process.returncode:
        raise HyrfError(f"{module} ended with exit code {process.returncode}", fix="see its messages above")
    return json.loads(process.stdout.splitlines()[-1])

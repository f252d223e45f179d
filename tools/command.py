"""Run the command line of a tool."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import NoReturn

from hyrfpack.cli.wording import use_option_names
from hyrfpack.errors import HyrfError


def run_command(main: Callable[[], int | None]) -> NoReturn:
    """Run `main` and exit with its code; after an error that the user can correct, print one line and exit with 2."""
    try:
        sys.exit(main())
    except HyrfError as error:
        print(f"error: {error.problem}; {use_option_names(error.fix)}", file=sys.stderr)
        sys.exit(2)

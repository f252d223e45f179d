"""The `hyrfpack` command, also `python -m hyrfpack`."""

from __future__ import annotations

import sys

from hyrfpack.errors import HyrfError, needs_package


def main() -> None:
    """Run the command line; if a package that it needs is missing, say so and exit with code 2."""
    try:
        with needs_package("the command line"):
            from hyrfpack.cli import main as run_command
    except HyrfError as error:
        print(f"Error: {error}", file=sys.stderr)
        sys.exit(2)
    run_command()


if __name__ == "__main__":
    main()

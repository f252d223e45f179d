"""Run the `hyrfpack` command as `python -m hyrfpack`."""

from hyrfpack.cli import main

main()

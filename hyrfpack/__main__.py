"""`python -m hyrfpack` is the `hyrfpack` command."""

from hyrfpack.cli import main

main()

"""Programs for maintainers; run them from the repository's root as `python -m tools.<wing>.<name> --help`.

gpu/ checks and measures the GPU kernels, and bench/ times operations against their references. studies/ holds the
experiments behind the documentation's tables. safety/ attacks files, readers and processes on purpose, and tests
other versions of the dependencies. browser/ drives browsers and minifies the web player.
"""

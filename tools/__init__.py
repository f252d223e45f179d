"""Programs for maintainers; run them from the repository's root as `python -m tools.<folder>.<name> --help`.

gpu/ checks and measures the GPU kernels, and bench/ times operations against their references. studies/ holds the
experiments behind the documentation's tables. safety/ damages files and interrupts processes on purpose, tests
other versions of the dependencies, and makes the golden files. browser/ drives browsers and builds the web player.
scenes/ writes synthetic data sets. command.py, cpu_time.py, json_files.py and tables.py are shared by these.
"""

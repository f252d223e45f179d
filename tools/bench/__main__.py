"""Times the hot operations: runs `bench()` of every module beside this file and prints a table of each.

    python -m tools.bench                    all of them
    python -m tools.bench --only rasterize   one
    python -m tools.bench --json out.json    the rows for a machine too

`bench()` returns one dictionary a row. Every row says how far off the result is beside how long it took, and ratios
come from runs interleaved in the same process; a bare time belongs to the machine named on the first line.
"""

from __future__ import annotations

import argparse
import json
import os
import pkgutil
import sys
from importlib import import_module
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table

# The torch references run on torch's own threads, which would go on spinning on the cores of the kernels timed next.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

from hyrfpack.measure.machine import describe_machine, format_machine
from tools.tables import cell

Row = dict[str, object]


def benchmarks() -> list[str]:
    """The modules beside this one."""
    return [module.name for module in pkgutil.iter_modules([str(Path(__file__).parent)]) if module.name != "__main__"]


def run(name: str) -> list[Row]:
    """The rows of one benchmark."""
    return import_module(f"tools.bench.{name}").bench()


def table(name: str, rows: list[Row]) -> Table:
    """Rows as an aligned table: one column a key, in order of first appearance, numbers to the right."""
    shown = Table(title=name, title_justify="left", title_style="bold")
    keys = list(dict.fromkeys(key for row in rows for key in row))
    for key in keys:
        numeric = any(isinstance(row.get(key), (int, float)) for row in rows)
        shown.add_column(key.replace("_", " "), justify="right" if numeric else "left", overflow="fold")
    for row in rows:
        shown.add_row(*(escape(cell(row.get(key))) for key in keys))
    return shown


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description="Time the hot operations against their references.")
    parser.add_argument("--only", action="append", choices=benchmarks(), metavar="NAME", help="run this one")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write machine and rows to FILE as well")
    asked = parser.parse_args(arguments)

    console = Console(width=None if sys.stdout.isatty() else 200, highlight=False)
    facts = describe_machine()
    console.print(format_machine(facts), markup=False)
    results = {}
    for name in asked.only or benchmarks():
        results[name] = run(name)
        console.print(table(name, results[name]))
    if asked.json:
        asked.json.write_text(json.dumps({"machine": facts, "results": results}, indent=1) + "\n")


if __name__ == "__main__":
    main()

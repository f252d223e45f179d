"""Time the hot operations: run `bench()` of every module beside this file and print one table for each.

    python -m tools.bench                    all benchmarks
    python -m tools.bench --only rasterize   one benchmark
    python -m tools.bench --json out.json    also write the rows to a JSON file

`bench()` returns one dictionary for each row. A row has the error of the result beside its time. Ratios come from
runs that alternate in the same process. Times in ms are valid only for the machine on the first line.
"""

from __future__ import annotations

import argparse
import os
import pkgutil
import sys
from importlib import import_module
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table

# Without this, torch's threads keep spinning after a reference has run and slow down the kernel that is timed next.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

from hyrfpack.measure.machine import describe_machine, format_machine
from tools.command import run_command
from tools.json_files import write_json
from tools.tables import format_cell

Row = dict[str, object]


def list_benchmarks() -> list[str]:
    """Return the names of the benchmark modules beside this file."""
    return [module.name for module in pkgutil.iter_modules([str(Path(__file__).parent)]) if module.name != "__main__"]


def run_benchmark(name: str) -> list[Row]:
    """Run one benchmark and return its rows."""
    return import_module(f"tools.bench.{name}").bench()


def format_table(name: str, rows: list[Row]) -> Table:
    """Format rows as an aligned table: one column for each key, in order of first appearance, numbers to the right."""
    shown = Table(title=name, title_justify="left", title_style="bold")
    keys = list(dict.fromkeys(key for row in rows for key in row))
    for key in keys:
        numeric = any(isinstance(row.get(key), (int, float)) for row in rows)
        shown.add_column(key.replace("_", " "), justify="right" if numeric else "left", overflow="fold")
    for row in rows:
        shown.add_row(*(escape(format_cell(row.get(key))) for key in keys))
    return shown


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description="Time the hot operations against their references.")
    parser.add_argument(
        "--only", action="append", choices=list_benchmarks(), help="run only this benchmark; may be given several times"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the machine and all rows so far to FILE")
    args = parser.parse_args(arguments)

    console = Console(width=None if sys.stdout.isatty() else 200, highlight=False)
    facts = describe_machine()
    console.print(format_machine(facts), markup=False)
    results = {}
    for name in args.only or list_benchmarks():
        results[name] = run_benchmark(name)
        console.print(format_table(name, results[name]))
        if args.json:
            write_json(args.json, {"machine": facts, "results": results})


if __name__ == "__main__":
    run_command(main)

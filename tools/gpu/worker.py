"""Run one part of the check in child processes, see `hyrfpack.parallel.child_items`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

from hyrfpack.errors import missing_package
from hyrfpack.parallel.child_items import describe_exception, run_items
from tools.gpu.rows import Row

OWN_PACKAGES = ("hyrfpack", "tools", "tests")


def run_child(run: Callable[[str], Iterator[Row]], items: Sequence[str], is_usable: Callable[[], bool]) -> int:
    """Run the items of a part in the child process and print their rows; return the exit code."""
    return run_items(run, items, is_usable, failure_row)


def failure_row(error: Exception) -> Row:
    """Return the row of an item that raised: "left out" if a package is missing, otherwise "failed"."""
    package = find_missing_package(error)
    if package:
        return {"status": "left out", "note": f"it needs {package}, which is not installed here"}
    return {"status": "failed", "note": describe_exception(error)}


def find_missing_package(error: BaseException | None) -> str | None:
    """Return the pip name of the missing third-party package that caused an error.

    It returns None if the error has another cause, or if the missing module is one of this repository.
    """
    while error is not None and not isinstance(error, ModuleNotFoundError):
        error = error.__cause__
    package = missing_package(error) if error else None
    return None if package in OWN_PACKAGES else package

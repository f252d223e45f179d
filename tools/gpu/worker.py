"""Run one part of the check in child processes, so that a failure there does not end the other parts.

A kernel with an illegal memory access leaves its whole process without a usable GPU. A kernel that hangs can only be
killed from another process. The child prints one line for each row and for each finished item. If the child ends early,
its current item has failed, and a new child runs the remaining items.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress

from hyrfpack.errors import missing_package
from tools.gpu.rows import Row

OWN_PACKAGES = ("hyrfpack", "tools", "tests")
# Prefixes of the lines by which a child reports to its parent.
ROW_PREFIX, BEGUN_PREFIX, DONE_PREFIX = "@row ", "@begun ", "@done "


def run_child(run: Callable[[str], Iterator[Row]], items: Sequence[str], is_usable: Callable[[], bool]) -> int:
    """Run the items in the child process and print their rows; return the exit code.

    Args:
        run: yields the rows of an item.
        items: the names of the items.
        is_usable: called after a failed item; if it returns False, the child ends with code 3 and leaves the remaining
            items to another child.
    """
    for item in items:
        _print(BEGUN_PREFIX + item)
        try:
            for row in run(item):
                _print(ROW_PREFIX + json.dumps({"item": item, **row}))
        except Exception as error:
            _print(ROW_PREFIX + json.dumps({"item": item, **failure_row(error)}))
            _print(DONE_PREFIX + item)
            if not is_usable():
                return 3
        else:
            _print(DONE_PREFIX + item)
    return 0


def failure_row(error: Exception) -> Row:
    """Return the row of an item that raised: "left out" if a package is missing, otherwise "failed"."""
    package = find_missing_package(error)
    if package:
        return {"status": "left out", "note": f"it needs {package}, which is not installed here"}
    message = " ".join(str(error).split()) or "no message"
    return {"status": "failed", "note": f"{type(error).__name__}: {message[:300]}"}


def find_missing_package(error: BaseException | None) -> str | None:
    """Return the pip name of the missing third-party package that caused an error.

    It returns None if the error has another cause, or if the missing module is one of this repository.
    """
    while error is not None and not isinstance(error, ModuleNotFoundError):
        error = error.__cause__
    package = missing_package(error) if error else None
    return None if package in OWN_PACKAGES else package


def run_in_children(command: Callable[[list[str]], list[str]], items: Sequence[str], seconds: float) -> Iterator[Row]:
    """Run the items in one or more child processes, called from the parent; yield the rows of all items.

    Args:
        command: returns the command of a child that runs the items it is given.
        items: the names of the items.
        seconds: time limit for all items together; unfinished items have failed.
    """
    remaining, end = list(items), time.monotonic() + seconds
    while remaining:
        remaining_before, current, last_line = len(remaining), None, ""
        for line in _lines(command(remaining), end - time.monotonic()):
            kind, _, rest = line.partition(" ")
            if kind + " " == ROW_PREFIX:
                yield json.loads(rest)
            elif kind + " " == BEGUN_PREFIX:
                current, last_line = rest, ""
            elif kind + " " == DONE_PREFIX:
                remaining.remove(rest)
                current = None
            else:
                last_line = line.strip() or last_line
        if remaining and time.monotonic() >= end:
            for item in remaining:
                note = f"not done within the part's {seconds:.0f} s"
                note += f"; last output: {last_line[:300]}" if item == current and last_line else ""
                yield {"item": item, "status": "failed", "note": note}
            return
        if current or len(remaining) == remaining_before:  # the child ended within an item, or before its first one
            failed_item = current or remaining[0]
            remaining.remove(failed_item)
            yield {
                "item": failed_item,
                "status": "failed",
                "note": f"its process ended: {last_line[:300] or 'no output'}",
            }


def _lines(command: list[str], seconds: float) -> Iterator[str]:
    """Yield the lines that a command prints until it ends or its time is over; then kill its process group."""
    child = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="replace", start_new_session=True
    )
    timer = threading.Timer(max(0.0, seconds), _kill, [child])
    timer.start()
    try:
        yield from (line.rstrip("\n") for line in child.stdout)
    finally:
        timer.cancel()
        _kill(child)
        child.wait()


def _kill(child: subprocess.Popen) -> None:
    with suppress(ProcessLookupError):
        os.killpg(child.pid, signal.SIGKILL)


def _print(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()

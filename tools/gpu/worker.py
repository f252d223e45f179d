"""Runs one part of the check in a process of its own, so that nothing that breaks there ends the rest.

A kernel that reads where it may not leaves the whole process without a usable GPU, and one that never ends can only be
killed from outside. The child prints a line for each row and for each item done; when it ends early, the item that it
was at has failed, and another child goes on with the next.
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

from tools.gpu.rows import Row

OURS = ("hyrfpack", "tools", "tests")
PIP_NAMES = {"PIL": "pillow"}  # of modules that are called otherwise
ROW, BEGUN, DONE = "@row ", "@begun ", "@done "  # what lines of a child begin with


def work(run: Callable[[str], Iterator[Row]], items: Sequence[str], is_usable: Callable[[], bool]) -> int:
    """In the child: go through the items and print what comes; returns the exit code.

    Args:
        run: yields the rows of an item.
        is_usable: asked after an item that failed; where it says no, the rest is left to another process.
    """
    for item in items:
        _print(BEGUN + item)
        try:
            for row in run(item):
                _print(ROW + json.dumps({"item": item, **row}))
        except Exception as error:
            _print(ROW + json.dumps({"item": item, **failure(error)}))
            _print(DONE + item)
            if not is_usable():
                return 3
        else:
            _print(DONE + item)
    return 0


def failure(error: Exception) -> Row:
    """The row of an item that raised."""
    package = missing_package(error)
    if package:
        return {"status": "left out", "note": f"it needs {package}, which is not installed here"}
    words = " ".join(str(error).split()) or "no message"
    return {"status": "failed", "note": f"{type(error).__name__}: {words[:300]}"}


def missing_package(error: BaseException | None) -> str | None:
    """What pip calls the package of others for want of which this was raised; None where it was raised for another
    reason, or for want of a module of ours."""
    while error is not None and not isinstance(error, ModuleNotFoundError):
        error = error.__cause__
    top = (error.name or "").partition(".")[0] if error else ""
    return None if top in ("", *OURS) else PIP_NAMES.get(top, top)


def run_items(command: Callable[[list[str]], list[str]], items: Sequence[str], seconds: float) -> Iterator[Row]:
    """In the parent: rows of all items, from as many children as it takes.

    Args:
        command: of a child that does the items it is given.
        seconds: for all of them; what is not done by then has failed.
    """
    left, end = list(items), time.monotonic() + seconds
    while left:
        before, at, last = len(left), None, ""
        for line in _lines(command(left), end - time.monotonic()):
            kind, _, rest = line.partition(" ")
            if kind + " " == ROW:
                yield json.loads(rest)
            elif kind + " " == BEGUN:
                at, last = rest, ""
            elif kind + " " == DONE:
                left.remove(rest)
                at = None
            else:
                last = line.strip() or last
        if left and time.monotonic() >= end:
            for item in left:
                note = f"not done within the part's {seconds:.0f} s"
                note += f"; last words: {last[:300]}" if item == at and last else ""
                yield {"item": item, "status": "failed", "note": note}
            return
        if at or len(left) == before:  # it broke off within an item, or did not even begin
            broken = at or left[0]
            left.remove(broken)
            yield {"item": broken, "status": "failed", "note": f"its process ended: {last[:300] or 'without a word'}"}


def _lines(command: list[str], seconds: float) -> Iterator[str]:
    """Lines that a command prints, until it ends or its time is over; then it is killed with all that it started."""
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

"""Run items of work in child processes, so that a crash or a hang of one item does not end the others.

A GPU kernel with an illegal memory access leaves its whole process without a usable GPU. A kernel that hangs can only
be killed from another process. The child prints one line for each row and for each finished item. If the child ends
early, its current item has failed, and a new child runs the remaining items.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import suppress
from math import inf
from pathlib import Path

# What an item reports. "item" is its name. "status" is "failed" or "left out", with the reason under "note"; a row
# without "status" passed. "is_temporary" is True if the item failed because of the machine's present state: it ran out
# of time or memory, or another program killed its process.
Row = dict[str, object]

# Prefixes of the lines by which a child reports to its parent.
ROW_PREFIX, BEGUN_PREFIX, DONE_PREFIX = "@row ", "@begun ", "@done "
# Exit code of a child whose device has become unusable.
UNUSABLE_DEVICE_CODE = 3
MAX_NOTE_LENGTH = 300
# Signals that other programs and the system's out-of-memory killer send; a process does not send them to itself.
_SIGNALS_FROM_OUTSIDE = ("SIGHUP", "SIGINT", "SIGKILL", "SIGTERM")
_IMPORT_ROOT = str(Path(__file__).parents[2])  # the folder from which hyrfpack was imported


def child_environment() -> dict[str, str]:
    """Return the environment of a child process that imports the same hyrfpack as this one, from any folder."""
    path = os.pathsep.join(filter(None, (_IMPORT_ROOT, os.environ.get("PYTHONPATH"))))
    return {**os.environ, "PYTHONPATH": path}


def run_items(
    run: Callable[[str], Iterator[Row]],
    items: Sequence[str],
    is_usable: Callable[[], bool],
    describe_failure: Callable[[Exception], Row],
) -> int:
    """Run the items in the child process and print their rows; return the exit code.

    Args:
        run: yields the rows of an item.
        items: the names of the items.
        is_usable: called after a failed item; if it returns False, the child ends with UNUSABLE_DEVICE_CODE and leaves
            the remaining items to another child.
        describe_failure: returns the row of an item that raised this exception.
    """
    for item in items:
        _print(BEGUN_PREFIX + item)
        try:
            for row in run(item):
                _print(ROW_PREFIX + json.dumps({"item": item, **row}))
        except Exception as error:
            _print(ROW_PREFIX + json.dumps({"item": item, **describe_failure(error)}))
            _print(DONE_PREFIX + item)
            if not is_usable():
                return UNUSABLE_DEVICE_CODE
        else:
            _print(DONE_PREFIX + item)
    return 0


def describe_exception(error: Exception) -> str:
    """Return an exception's type and message as one line."""
    message = " ".join(str(error).split()) or "no message"
    return f"{type(error).__name__}: {message[:MAX_NOTE_LENGTH]}"


def signal_name(code: int) -> str:
    """Return the name of the signal that ended a process with this exit code, or "" if none did.

    Example:
        >>> signal_name(-15), signal_name(3)
        ('SIGTERM', '')
    """
    if code >= 0:
        return ""
    with suppress(ValueError):  # real-time signals but two have no name
        return signal.Signals(-code).name
    return f"signal {-code}"


def run_in_children(
    command: Callable[[list[str]], list[str]],
    items: Sequence[str],
    seconds: float,
    item_seconds: float = inf,
    self_timed: Collection[str] = (),
) -> Iterator[Row]:
    """Run the items in one or more child processes, called from the parent; yield the rows of all items.

    Args:
        command: returns the command of a child that runs the items it is given.
        items: the names of the items.
        seconds: time limit for all items together; unfinished items have failed.
        item_seconds: time limit for each item, and for the start of a child; the remaining items still run.
        self_timed: names of items that keep a limit of their own, to which `item_seconds` does not apply.
    """
    remaining, end = list(items), time.monotonic() + seconds

    def remaining_seconds(item: str) -> float:
        return min(inf if item in self_timed else item_seconds, end - time.monotonic())

    while remaining:
        remaining_before, current, last_line = len(remaining), None, ""
        child = _Child(command(remaining))
        try:
            child.limit_time(remaining_seconds(remaining[0]))
            for line in child.lines():
                kind, _, content = line.partition(" ")
                if kind + " " == ROW_PREFIX:
                    yield json.loads(content)
                elif kind + " " == BEGUN_PREFIX:
                    current, last_line = content, ""
                    child.limit_time(remaining_seconds(content))
                elif kind + " " == DONE_PREFIX:
                    remaining.remove(content)
                    current = None
                else:
                    last_line = line.strip() or last_line
        finally:
            killed_by = child.stop()
        last_output = f"; last output: {last_line[:MAX_NOTE_LENGTH]}" if last_line else ""
        if remaining and time.monotonic() >= end:
            for item in remaining:
                note = f"not done within the part's {seconds:.0f} s" + (last_output if item == current else "")
                yield {"item": item, "status": "failed", "note": note, "is_temporary": True}
            return
        if current or len(remaining) == remaining_before:  # the child ended within an item, or before its first one
            failed_item = current or remaining[0]
            remaining.remove(failed_item)
            row: Row = {"item": failed_item, "status": "failed"}
            if child.is_out_of_time:
                yield row | {"note": f"not done within {item_seconds:.0f} s{last_output}", "is_temporary": True}
                continue
            cause = f" by {killed_by}" if killed_by else ""
            row["note"] = f"its process ended{cause}: {last_line[:MAX_NOTE_LENGTH] or 'no output'}"
            yield row | ({"is_temporary": True} if killed_by in _SIGNALS_FROM_OUTSIDE else {})


class _Child:
    """A child process in a process group of its own, which a timer kills.

    Attributes:
        is_out_of_time: whether the timer has killed it.
    """

    def __init__(self, command: list[str]) -> None:
        self.is_out_of_time = False
        self._process = subprocess.Popen(
            command,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            env=child_environment(),
            start_new_session=True,
        )
        self._timer = threading.Timer(0, self._kill)

    def lines(self) -> Iterator[str]:
        """Yield the lines that the process prints until it ends."""
        assert self._process.stdout is not None
        yield from (line.rstrip("\n") for line in self._process.stdout)

    def limit_time(self, seconds: float) -> None:
        """Kill the process `seconds` from now, instead of at the end of an earlier limit."""
        self._timer.cancel()
        self._timer = threading.Timer(max(0.0, seconds), self._expire)
        self._timer.daemon = True
        self._timer.start()

    def stop(self) -> str:
        """Kill what is left of the process group; return the name of the signal that ended the process, "" if none."""
        self._timer.cancel()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(0.5)  # A process that has closed its output is about to end by itself.
        self._kill()
        return signal_name(self._process.wait())

    def _expire(self) -> None:
        self.is_out_of_time = True
        self._kill()

    def _kill(self) -> None:
        with suppress(ProcessLookupError, PermissionError):
            if hasattr(os, "killpg"):
                os.killpg(self._process.pid, signal.SIGKILL)
            else:
                self._process.kill()


def _print(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()

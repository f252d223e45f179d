"""Report the progress of long pycolmap calls: a second thread reads the files that they write."""

from __future__ import annotations

import sqlite3
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Event, Thread

from hyrfpack.poses import count_rows as count_rows_script
from hyrfpack.poses.job import Job
from hyrfpack.progress import Progress, TaskEvent

POLL_INTERVAL_SECONDS = 1.0

# For each phase of the global mapper: the line in its log at the start, the name of the phase, and the ratio of the
# mapping that is done before it, measured on sets of 50 to 100 photos.
_GLOBAL_PHASES = (
    ("=== Running rotation averaging", "camera rotations", 0.02),
    ("=== Running track establishment", "tracks of points", 0.04),
    ("=== Running global positioning", "positions of cameras and points", 0.06),
    ("=== Running iterative bundle adjustment", "bundle adjustment", 0.5),
    ("=== Running iterative retriangulation", "triangulation and refinement", 0.7),
)


@contextmanager
def poll_in_background(poll: Callable[[], None]) -> Iterator[None]:
    """Call `poll` every POLL_INTERVAL_SECONDS from a second thread while the block runs.

    Read errors in `poll` are ignored, such as a locked database or a log that does not exist yet.
    """
    stopped = Event()

    def poll_until_stopped() -> None:
        while not stopped.wait(POLL_INTERVAL_SECONDS):
            with suppress(sqlite3.Error, OSError):
                poll()

    thread = Thread(target=poll_until_stopped, daemon=True)
    thread.start()
    try:
        yield
    finally:
        stopped.set()
        thread.join()


class RowCounter:
    """Counts the rows of a table of the database, also while pycolmap writes to it.

    A process of its own counts, see `count_rows.py` for the reason.
    """

    def __init__(self, job: Job, table: str) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-I", count_rows_script.__file__, job.database_path, table],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            encoding="utf-8",
        )

    def count(self) -> int:
        """Return the number of rows.

        Raises:
            sqlite3.Error: the table cannot be read at the moment.
            OSError: the counting process has ended.
        """
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write("\n")
        self._process.stdin.flush()
        answer = self._process.stdout.readline().strip()
        if not answer.isdigit():
            raise sqlite3.OperationalError(answer or "the process that counts rows has ended")
        return int(answer)

    def __enter__(self) -> RowCounter:
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(OSError):  # a broken pipe, if the process has ended
            self._process.communicate()


def count_rows(job: Job, table: str) -> int:
    """Return the number of rows in a table of the database.

    Raises:
        sqlite3.Error: the table cannot be read at the moment.
    """
    with RowCounter(job, table) as counter:
        return counter.count()


@contextmanager
def report_new_rows(job: Job, table: str, report_count: Callable[[int], None]) -> Iterator[None]:
    """While the block runs, report how many rows a table has gained since the block began."""
    with RowCounter(job, table) as counter:
        before = counter.count()
        with poll_in_background(lambda: report_count(max(counter.count() - before, 0))):
            yield


@contextmanager
def report_global_mapping_phase(log: Path, task: str, report_progress: Progress) -> Iterator[None]:
    """While the block runs, report the phase of the global mapper, read from its log.

    Args:
        log: file of pycolmap's messages.
        task: description that comes before the phase.
        report_progress: called with `TaskEvent`s, whose share is that of the mapping.
    """
    before = log.stat().st_size if log.exists() else 0

    def poll() -> None:
        with log.open("rb") as file:
            file.seek(before)
            text = file.read().decode("utf-8", "replace")
        phase, share = parse_global_mapping_phase(text)
        if phase:
            report_progress(TaskEvent(f"{task}: {phase}", share))

    with poll_in_background(poll):
        yield


def parse_global_mapping_phase(log: str) -> tuple[str, float]:
    """Return the global mapper's current phase and the ratio of work before it; ("", 0.0) before the first phase."""
    started = [(log.rfind(mark), name, share) for mark, name, share in _GLOBAL_PHASES if mark in log]
    if not started:
        return "", 0.0
    offset, name, share = max(started)
    if name == "bundle adjustment":
        rounds = log.count("fixed-rotation stage finished", offset)
        return (f"{name}, round {rounds + 1}", min(share + 0.06 * rounds, 0.69))
    return name, share

"""Progress of long pycolmap calls, which report nothing: a second thread reads the files that they write."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Event, Thread

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


def count_rows(job: Job, table: str) -> int:
    """Return the number of rows in a table of the database, also while the library writes to it.

    Raises:
        sqlite3.Error: the table cannot be read at the moment.
    """
    connection = sqlite3.connect(f"{job.database.resolve().as_uri()}?mode=ro", uri=True, timeout=0.5)
    try:
        return int(connection.execute(f"SELECT COUNT(*) FROM {table}").fetchone()[0])
    finally:
        connection.close()


@contextmanager
def report_new_rows(job: Job, table: str, report_count: Callable[[int], None]) -> Iterator[None]:
    """While the block runs, report how many rows a table has gained since the block began."""
    before = count_rows(job, table)
    with poll_in_background(lambda: report_count(max(count_rows(job, table) - before, 0))):
        yield


@contextmanager
def report_global_mapping_phase(log: Path, doing: str, report_progress: Progress) -> Iterator[None]:
    """While the block runs, report the phase of the global mapper, read from its log.

    Args:
        log: file of the library's messages.
        doing: description that comes before the phase.
        report_progress: called with `TaskEvent`s, whose share is that of the mapping.
    """
    before = log.stat().st_size if log.exists() else 0

    def poll() -> None:
        with log.open("rb") as file:
            file.seek(before)
            text = file.read().decode("utf-8", "replace")
        phase, share = parse_global_mapping_phase(text)
        if phase:
            report_progress(TaskEvent(f"{doing}: {phase}", share))

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

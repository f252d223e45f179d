"""Progress of long calls into the library, which say nothing themselves: a second thread looks at what they write."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Event, Thread

from hyrfpack.poses.job import Job
from hyrfpack.poses.process import Tell

LOOK_SECONDS = 1.0  # between two looks

# What the global mapper writes into its log as it begins a phase; what the phase is called; the share of the mapping
# that was done before it, as measured on sets of 50 to 100 photos.
_GLOBAL_PHASES = (
    ("=== Running rotation averaging", "camera rotations", 0.02),
    ("=== Running track establishment", "tracks of points", 0.04),
    ("=== Running global positioning", "positions of cameras and points", 0.06),
    ("=== Running iterative bundle adjustment", "bundle adjustment", 0.5),
    ("=== Running iterative retriangulation", "triangulation and refinement", 0.7),
)


@contextmanager
def watching(look: Callable[[], None]) -> Iterator[None]:
    """Call `look` every second from a second thread while the block runs.

    What keeps `look` from reading (a locked database, a log that is not there yet) is passed over.
    """
    over = Event()

    def watch() -> None:
        while not over.wait(LOOK_SECONDS):
            with suppress(sqlite3.Error, OSError):
                look()

    thread = Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def count_rows(job: Job, table: str) -> int:
    """How many rows a table of the database has, also while the library writes to it.

    Raises:
        sqlite3.Error: it cannot be read at the moment.
    """
    connection = sqlite3.connect(f"{job.database.resolve().as_uri()}?mode=ro", uri=True, timeout=0.5)
    try:
        return int(connection.execute(f"SELECT COUNT(*) FROM {table}").fetchone()[0])
    finally:
        connection.close()


@contextmanager
def watching_rows(job: Job, table: str, tell: Callable[[int], None]) -> Iterator[None]:
    """Tell how many rows a table has got since the block began, while it runs."""
    before = count_rows(job, table)
    with watching(lambda: tell(max(count_rows(job, table) - before, 0))):
        yield


@contextmanager
def watching_global_mapper(log: Path, doing: str, tell: Tell) -> Iterator[None]:
    """Tell the phase that the global mapper is in, by the log that it writes to, while the block runs.

    Args:
        log: file that the library's messages go to.
        doing: words before the phase.
        tell: called with the words and the share of the mapping that is done.
    """
    before = log.stat().st_size if log.exists() else 0

    def look() -> None:
        with log.open("rb") as file:
            file.seek(before)
            text = file.read().decode("utf-8", "replace")
        phase, share = global_mapping_phase(text)
        if phase:
            tell(f"{doing}: {phase}", share)

    with watching(look):
        yield


def global_mapping_phase(log: str) -> tuple[str, float]:
    """The phase of the global mapper and the share of its work before it, by its log; ("", 0.0) before the first."""
    begun = [(log.rfind(mark), name, share) for mark, name, share in _GLOBAL_PHASES if mark in log]
    if not begun:
        return "", 0.0
    place, name, share = max(begun)
    if name == "bundle adjustment":
        rounds = log.count("fixed-rotation stage finished", place)
        return (f"{name}, round {rounds + 1}", min(share + 0.06 * rounds, 0.69))
    return name, share

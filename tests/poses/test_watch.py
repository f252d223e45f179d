"""Progress of long library calls is read from what the library writes, and reported at least every two seconds."""

from __future__ import annotations

import sqlite3
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from hyrfpack.config.poses import PosesConfig
from hyrfpack.poses import process, watch
from hyrfpack.poses.job import Job
from hyrfpack.poses.watch import count_rows, parse_global_mapping_phase, poll_in_background, report_new_rows
from hyrfpack.progress import TaskEvent

# Lines of pycolmap 4.2.1's global mapper, in the order of its work.
MAPPER_LOG = [
    "I2026 global_mapper.cc:553] === Running rotation averaging ===",
    "I2026 global_mapper.cc:565] === Running track establishment ===",
    "I2026 global_mapper.cc:575] === Running global positioning ===",
    "I2026 global_mapper.cc:596] === Running iterative bundle adjustment ===",
    "I2026 global_mapper.cc:391] Global bundle adjustment iteration 1 / 3, fixed-rotation stage finished",
    "I2026 global_mapper.cc:401] Global bundle adjustment iteration 1 / 3 finished",
    "I2026 global_mapper.cc:391] Global bundle adjustment iteration 2 / 3, fixed-rotation stage finished",
    "I2026 global_mapper.cc:614] === Running iterative retriangulation and refinement ===",
]


def job_with_pairs(folder: Path, count: int) -> Job:
    job = Job(folder, folder, ("a.png",), (), (0,), {}, "exhaustive", 0)
    connection = sqlite3.connect(job.database_path)
    connection.execute("PRAGMA journal_mode=WAL")
    connection.execute("CREATE TABLE two_view_geometries (pair_id INTEGER)")
    connection.executemany("INSERT INTO two_view_geometries VALUES (?)", [(number,) for number in range(count)])
    connection.commit()
    connection.close()
    return job


def test_the_phase_of_the_global_mapper_follows_its_log_and_never_goes_back():
    found = [parse_global_mapping_phase("\n".join(MAPPER_LOG[:lines])) for lines in range(len(MAPPER_LOG) + 1)]
    assert [phase for phase, _ in found] == [
        "",
        "camera rotations",
        "tracks of points",
        "positions of cameras and points",
        "bundle adjustment, round 1",
        "bundle adjustment, round 2",
        "bundle adjustment, round 2",
        "bundle adjustment, round 3",
        "triangulation and refinement",
    ]
    shares = [share for _, share in found]
    assert shares == sorted(shares) and shares[0] == 0 and shares[-1] < 1


def test_rows_are_counted_while_another_connection_writes(tmp_path):
    job = job_with_pairs(tmp_path, 5)
    writer = sqlite3.connect(job.database_path)
    writer.execute("INSERT INTO two_view_geometries VALUES (9)")  # the transaction is not committed
    assert count_rows(job, "two_view_geometries") == 5
    writer.commit()
    assert count_rows(job, "two_view_geometries") == 6
    writer.close()


@pytest.mark.skipif(sys.platform == "win32", reason="closing a file drops locks on POSIX systems only")
def test_counting_keeps_the_locks_that_the_library_holds_on_the_database(tmp_path):
    # pycolmap has a copy of SQLite of its own. If this process closed the database elsewhere, the system would drop
    # the locks of that copy, and the two would damage the file.
    import fcntl

    job, place = job_with_pairs(tmp_path, 5), 1 << 20
    take_lock = f"import fcntl, sys; fcntl.lockf(open(sys.argv[1], 'r+b'), {fcntl.LOCK_EX | fcntl.LOCK_NB}, 1, {place})"
    with job.database_path.open("r+b") as file:
        fcntl.lockf(file, fcntl.LOCK_EX, 1, place)
        counts: list[int] = []
        with report_new_rows(job, "two_view_geometries", counts.append):
            assert count_rows(job, "two_view_geometries") == 5
        other = subprocess.run([sys.executable, "-c", take_lock, job.database_path], capture_output=True, check=False)

    assert other.returncode != 0 and b"BlockingIOError" in other.stderr


def test_a_missing_table_is_an_error_of_the_database(tmp_path):
    with pytest.raises(sqlite3.Error, match="no such table: matches"):
        count_rows(job_with_pairs(tmp_path, 5), "matches")


def test_rows_that_a_long_call_writes_are_reported_while_it_runs(tmp_path, monkeypatch):
    monkeypatch.setattr(watch, "POLL_INTERVAL_SECONDS", 0.01)
    job, messages, seen = job_with_pairs(tmp_path, 5), [], threading.Event()

    def tell(count: int) -> None:
        messages.append(count)
        if count == 2:
            seen.set()

    with report_new_rows(job, "two_view_geometries", tell):
        writer = sqlite3.connect(job.database_path)
        writer.executemany("INSERT INTO two_view_geometries VALUES (?)", [(6,), (7,)])
        writer.commit()
        writer.close()
        assert seen.wait(60)
    assert messages == sorted(messages) and messages[-1] == 2


def test_a_failing_progress_reader_does_not_end_the_watched_call(monkeypatch):
    monkeypatch.setattr(watch, "POLL_INTERVAL_SECONDS", 0.01)
    tried = threading.Event()

    def look() -> None:
        tried.set()
        raise sqlite3.OperationalError("database is locked")

    with poll_in_background(look):
        assert tried.wait(60)


def test_progress_of_a_silent_stage_is_repeated(tmp_path, monkeypatch):
    """The worker reports once and ends only when its report was repeated three times."""
    monkeypatch.setattr(process, "MAX_SILENCE_SECONDS", 0.05)
    script = (
        "import sys, json; print(json.dumps({'doing': 'solving', 'share': 0.5}), flush=True); sys.stdin.read(1); "
        "print(json.dumps({'answer': {'found': 1}}), flush=True)"
    )
    worker = subprocess.Popen([sys.executable, "-c", script], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    events: list[TaskEvent] = []
    solving = TaskEvent("solving", 0.5)

    def take(event: TaskEvent) -> None:
        events.append(event)
        if events.count(solving) == 3:
            assert worker.stdin is not None
            worker.stdin.write("x")
            worker.stdin.flush()

    answer = process._read_answer(worker, take, "starting")
    process._terminate(worker)
    assert answer == {"found": 1}
    assert events[0] == TaskEvent("starting", 0.0) and events.count(solving) >= 3


def test_every_stage_reports_progress_in_its_own_units(estimated_scene):
    tasks = [event.task for event in estimated_scene[2]]
    for words in (
        "reading the headers of photos 8/8",
        "copying photos 8/8",
        "finding features in photo ",
        "matching pair ",
        "estimating focal lengths",
        "global mapping",
        "incremental mapping, 8/8 photos registered",
        "comparing both reconstructions",
        "triangulating points",
        "estimating the lens distortion",
        "colouring points, photo 8/8",
    ):
        assert any(words in task for task in tasks), words


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_progress_reported_out_of_order_never_decreases(share, tmp_path):
    from hyrfpack.poses.estimate import _PoseEstimation

    events: list[TaskEvent] = []
    estimation = _PoseEstimation(tmp_path, tmp_path / "scene", PosesConfig(), None, False, events.append)
    estimation._report_progress("matches", TaskEvent("matching", 0.9))
    estimation._report_progress("matches", TaskEvent("matching", share))
    assert events[0] == events[1]


@pytest.mark.parametrize("is_video", [False, True])
@pytest.mark.parametrize("is_repeated", [False, True])
def test_the_shares_of_all_stages_that_run_join_without_a_gap(is_repeated, is_video, tmp_path):
    from hyrfpack.poses.estimate import _PoseEstimation

    estimation = _PoseEstimation(tmp_path, tmp_path / "scene", PosesConfig(), None, False, lambda event: None)
    estimation.is_video = is_video
    end = 0.0
    for stage in ("photos", "features", "matches", "global", "incremental", *["repeat"] * is_repeated, "finish"):
        start, length = estimation._stage_interval(stage)
        assert start == pytest.approx(end)
        end = start + length
        estimation.seconds[stage] = 1.0
    assert end == pytest.approx(1.0)

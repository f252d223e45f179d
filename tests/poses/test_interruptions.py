"""An estimation that is stopped, killed, or let down by the library: what is done is kept."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

import hyrfpack
from hyrfpack.poses import process

ROOT = Path(__file__).parents[2]
CRASH = """
import os, sys
if sys.orig_argv[-1] == {stage!r} and "hyrfpack.poses.worker" in sys.orig_argv:
    os.abort()
"""


@pytest.fixture
def started(monkeypatch) -> list[subprocess.Popen]:
    """The processes that stages are run in."""
    found: list[subprocess.Popen] = []
    popen = subprocess.Popen

    def start(*arguments, **options):
        found.append(popen(*arguments, **options))
        return found[-1]

    monkeypatch.setattr(process.subprocess, "Popen", start)
    return found


def test_what_is_stopped_ends_at_once_and_goes_on_where_it_was(taken, tmp_path, started):
    out = tmp_path / "scene"

    def stop(doing: str, share: float) -> None:
        if "at once" in doing:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        hyrfpack.estimate_poses(taken[0], out, report=stop)
    assert all(worker.poll() is not None for worker in started)
    kept = (out / ".poses" / "matches.json").stat().st_mtime_ns
    assert not (out / "sparse").exists()

    seen: list[bool] = []

    def look(doing: str, share: float) -> None:
        if "one by one" in doing and not seen:
            seen.append((out / ".poses" / "matches.json").stat().st_mtime_ns == kept)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        hyrfpack.estimate_poses(taken[0], out, report=look)
    assert seen == [True]
    assert (out / ".poses" / "global-0").is_dir()


def test_a_worker_that_is_killed_is_one_sentence_and_the_same_call_goes_on(taken, tmp_path, started):
    out = tmp_path / "scene"

    def kill(doing: str, share: float) -> None:
        if "matching pair" in doing:
            started[-1].kill()

    with pytest.raises(hyrfpack.HyrfError, match="more memory than there is.*goes on here"):
        hyrfpack.estimate_poses(taken[0], out, report=kill)
    said: list[str] = []
    report = hyrfpack.estimate_poses(taken[0], out, say=said.append)
    assert "an interrupted estimation goes on" in said
    assert report.registered == len(taken[1])
    assert sorted(os.listdir(out)) == ["images", "poses.json", "sparse"]


def test_a_crash_of_the_library_is_one_sentence(taken, tmp_path, monkeypatch):
    (tmp_path / "sitecustomize.py").write_text(CRASH.format(stage="matches"))
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    with pytest.raises(hyrfpack.HyrfError, match="matching photos ended by signal SIGABRT.*run the same command again"):
        hyrfpack.estimate_poses(taken[0], tmp_path / "scene")


def test_where_one_mapper_crashes_the_other_ones_result_is_taken_and_said(taken, tmp_path, monkeypatch):
    (tmp_path / "sitecustomize.py").write_text(CRASH.format(stage="global"))
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    report = hyrfpack.estimate_poses(taken[0], tmp_path / "scene")
    assert (report.mapper, report.registered, report.sure) == ("incremental", len(taken[1]), 0)
    assert any("the global mapper failed" in note for note in report.notes)
    assert any("nothing confirms" in note for note in report.notes)


@pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")
@pytest.mark.parametrize("number, code", [(signal.SIGINT, 1), (signal.SIGKILL, -signal.SIGKILL)])
def test_the_command_takes_its_worker_along(number, code, taken, tmp_path, signals):
    command = [sys.executable, "-m", "hyrfpack", "poses", str(taken[0]), "-o", str(tmp_path / "scene")]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    parent = subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True, cwd=tmp_path)
    worker = None
    while worker is None and parent.poll() is None:
        children = Path(f"/proc/{parent.pid}/task/{parent.pid}/children").read_text().split()
        worker = next(iter(children), None)
        time.sleep(0.05)
    time.sleep(0.5)
    parent.send_signal(number)
    _, errors = parent.communicate(timeout=15)
    assert parent.returncode == code
    assert "Traceback" not in errors
    if number == signal.SIGINT:
        assert "the same command goes on from here" in errors
    deadline = time.monotonic() + 5
    while time.monotonic() < deadline and Path(f"/proc/{worker}").exists():
        time.sleep(0.05)
    assert not Path(f"/proc/{worker}").exists()

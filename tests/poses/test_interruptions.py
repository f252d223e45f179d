"""An estimation that is stopped, killed or crashes keeps its finished stages."""

from __future__ import annotations

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from commands import succeeded

import hyrfpack
from hyrfpack.atomic import write_atomic
from hyrfpack.context import RunContext
from hyrfpack.poses import process, worker
from hyrfpack.poses.output import disk_full_error, explain_disk_errors
from hyrfpack.progress import TaskEvent

REPOSITORY_ROOT = Path(__file__).parents[2]
CRASH_AT_STAGE_CODE = """
import os, sys
if sys.orig_argv[-1] == {stage!r} and "hyrfpack.poses.worker" in sys.orig_argv:
    os.abort()
"""
FULL_DISK_CODE = """
import sys
if sys.orig_argv[-1] == "features" and "hyrfpack.poses.worker" in sys.orig_argv:
    import errno
    import hyrfpack.poses.features

    def write_on_full_disk(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    hyrfpack.poses.features._write_working_copy = write_on_full_disk
"""
MAPPERS_DISAGREE_CODE = """
import sys
if "hyrfpack.poses.worker" in sys.orig_argv:
    import hyrfpack.poses.choose
    hyrfpack.poses.choose._MIN_AGREEING_RATIO = 2.0
"""


def record_processes(monkeypatch: pytest.MonkeyPatch) -> list[subprocess.Popen]:
    """Record the processes in which stages run from now on."""
    found: list[subprocess.Popen] = []
    popen = subprocess.Popen

    def start(*arguments, **options):
        found.append(popen(*arguments, **options))
        return found[-1]

    monkeypatch.setattr(process.subprocess, "Popen", start)
    return found


@pytest.fixture
def stage_processes(monkeypatch) -> list[subprocess.Popen]:
    return record_processes(monkeypatch)


def stop_at(moment: str) -> RunContext:
    """Return a context that interrupts when the description of the task contains these words."""
    tasks: list[str] = []
    return RunContext(
        progress=lambda event: tasks.append(event.task), stop=lambda: any(moment in task for task in tasks)
    )


@pytest.fixture(scope="module")
def stopped_after_matching(photos_and_poses, tmp_path_factory) -> Path:
    """A scene whose estimation was stopped after matching. Tests must not change it."""
    out = tmp_path_factory.mktemp("stopped") / "scene"
    with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyboardInterrupt):
        workers = record_processes(patch)
        hyrfpack.estimate_poses(photos_and_poses[0], out, context=stop_at("global mapping"))
    assert len(workers) == 3 and all(worker.poll() is not None for worker in workers)
    return out


def test_a_stopped_estimation_resumes_after_its_last_finished_stage(photos_and_poses, stopped_after_matching, tmp_path):
    out, kept = tmp_path / "scene", (stopped_after_matching / ".poses" / "matches.json").stat().st_mtime_ns
    shutil.copytree(stopped_after_matching, out)
    assert os.listdir(out) == [".poses"]
    with pytest.raises(KeyboardInterrupt):
        hyrfpack.estimate_poses(photos_and_poses[0], out, context=stop_at("incremental"))
    assert (out / ".poses" / "matches.json").stat().st_mtime_ns == kept
    assert (out / ".poses" / "global-0").is_dir()


def test_mappers_that_agree_are_not_repeated(estimated_scene):
    assert "repeat" not in estimated_scene[1].seconds
    assert not any("run 2/3" in event.task for event in estimated_scene[2])


@pytest.fixture(scope="module")
def disagreeing_mappers(tmp_path_factory) -> str:
    """A folder for PYTHONPATH with which the mappers never confirm each other."""
    folder = tmp_path_factory.mktemp("disagree")
    (folder / "sitecustomize.py").write_text(MAPPERS_DISAGREE_CODE)
    return str(folder)


@pytest.fixture(scope="module")
def repeated_scene(
    photos_and_poses, stopped_after_matching, disagreeing_mappers, tmp_path_factory
) -> tuple[Path, list]:
    """A scene for which the mappers were repeated, and the events that were reported. Tests must not change it."""
    out, events = tmp_path_factory.mktemp("repeated") / "scene", []
    shutil.copytree(stopped_after_matching, out)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", disagreeing_mappers)
        hyrfpack.estimate_poses(photos_and_poses[0], out, context=RunContext(progress=events.append))
    return out, events


def test_mappers_that_disagree_are_repeated(repeated_scene):
    shares = [event.share for event in repeated_scene[1]]
    assert shares == sorted(shares) and shares[-1] <= 1
    for words in ("global mapping, run 2/3", "global mapping, run 3/3"):
        assert any(words in event.task for event in repeated_scene[1])


def test_an_estimation_stopped_in_each_state_of_mapping_ends_with_the_same_bytes(
    photos_and_poses, stopped_after_matching, disagreeing_mappers, repeated_scene, tmp_path, monkeypatch
):
    out = tmp_path / "scene"
    shutil.copytree(stopped_after_matching, out)
    monkeypatch.setenv("PYTHONPATH", disagreeing_mappers)
    for moment in ("global mapping", "incremental mapping", "run 2/3", "run 3/3", "comparing both", "lens distortion"):
        with pytest.raises(KeyboardInterrupt):
            hyrfpack.estimate_poses(photos_and_poses[0], out, context=stop_at(moment))
    hyrfpack.estimate_poses(photos_and_poses[0], out)
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        path = Path("sparse", "0", name)
        assert (out / path).read_bytes() == (repeated_scene[0] / path).read_bytes()


def test_when_repeated_mappers_crash_the_first_results_are_used(
    photos_and_poses, stopped_after_matching, tmp_path, monkeypatch
):
    shutil.copytree(stopped_after_matching, tmp_path / "scene")
    code = MAPPERS_DISAGREE_CODE + CRASH_AT_STAGE_CODE.format(stage="repeat")
    (tmp_path / "sitecustomize.py").write_text(code)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    report = hyrfpack.estimate_poses(photos_and_poses[0], tmp_path / "scene")
    assert report.registered == report.sure == len(photos_and_poses[1])
    assert any("first results are used" in note for note in report.notes)


def test_poses_in_place_are_completed_after_the_worker_was_killed(photos_and_poses, tmp_path, stage_processes):
    shutil.copytree(photos_and_poses[0], tmp_path / "images")
    before = {path.name: path.stat().st_mtime_ns for path in (tmp_path / "images").iterdir()}
    (tmp_path / "poses.json").write_text("{}")  # as left by poses that were removed

    def kill(event: TaskEvent) -> None:
        if "matching pair" in event.task:
            stage_processes[-1].kill()

    with pytest.raises(hyrfpack.HyrfError, match="more memory than is available.*resumes here"):
        hyrfpack.estimate_poses(tmp_path, tmp_path, overwrite=True, context=RunContext(progress=kill))
    result = succeeded("poses", tmp_path, "-o", tmp_path, "--overwrite", "--json")
    assert "resuming an interrupted estimation" in result.stderr
    assert json.loads(result.stdout)["registered"] == len(before)
    assert {path.name: path.stat().st_mtime_ns for path in (tmp_path / "images").iterdir()} == before
    assert sorted(os.listdir(tmp_path)) == ["images", "poses.json", "sparse"]


def test_a_crash_of_the_library_is_a_clear_error(photos_and_poses, tmp_path, monkeypatch):
    (tmp_path / "sitecustomize.py").write_text(CRASH_AT_STAGE_CODE.format(stage="matches"))
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    with pytest.raises(hyrfpack.HyrfError, match="matching photos ended by SIGABRT.*run the same command again"):
        hyrfpack.estimate_poses(photos_and_poses[0], tmp_path / "scene")


def test_a_full_disk_while_features_are_sought_keeps_the_work(photos_and_poses, tmp_path, monkeypatch):
    (tmp_path / "sitecustomize.py").write_text(FULL_DISK_CODE)
    out = tmp_path / "scene"
    with monkeypatch.context() as patch:
        patch.setenv("PYTHONPATH", str(tmp_path))
        with pytest.raises(hyrfpack.HyrfError, match="the disk is full; free some space.*resumes here") as caught:
            hyrfpack.estimate_poses(photos_and_poses[0], out)
    assert not isinstance(caught.value, hyrfpack.HyrfDataError)
    assert len(list((out / ".poses" / "images").iterdir())) == len(photos_and_poses[1])
    with pytest.raises(KeyboardInterrupt):
        hyrfpack.estimate_poses(photos_and_poses[0], out, context=stop_at("matching"))
    assert (out / ".poses" / "features.json").exists()


@pytest.mark.integration
@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT])
def test_a_small_file_that_meets_a_full_disk_says_how_to_resume(tmp_path, monkeypatch, capsys, number):
    def write_on_full_disk(*_):
        raise OSError(number, os.strerror(number))

    def run_stage(*_):
        write_atomic(tmp_path / "features.json", b"{}")

    monkeypatch.setattr(os, "fsync", write_on_full_disk)
    with pytest.raises(hyrfpack.HyrfError) as caught, explain_disk_errors(tmp_path):
        run_stage()
    expected = disk_full_error(tmp_path)
    assert str(caught.value) == str(expected)
    monkeypatch.setattr(worker, "_exit_with_parent", lambda: None)  # it would end the test
    monkeypatch.setattr(worker.Job, "load", lambda path: None)
    monkeypatch.setattr(worker, "run", run_stage)
    worker.main(str(tmp_path / "job.json"), "features")
    assert json.loads(capsys.readouterr().out)["answer"] == {"failed": [expected.problem, expected.fix]}


@pytest.mark.integration
def test_an_empty_log_on_a_full_disk_is_reported_as_a_full_disk(tmp_path, monkeypatch):
    (tmp_path / "features.log").touch()
    assert "ended with code 1" in process._crash_error("features", 1, tmp_path / "features.log").problem
    monkeypatch.setattr(process.shutil, "disk_usage", lambda folder: shutil._ntuple_diskusage(1 << 30, 1 << 30, 4096))
    error = process._crash_error("features", 1, tmp_path / "features.log")
    assert error.problem == f"{tmp_path}: the disk is full" and "resumes here" in error.fix


@pytest.mark.integration
def test_a_signal_without_a_name_is_reported_by_its_number(tmp_path):
    """Real-time signals have no names in Python, but for the first and the last."""
    error = process._crash_error("matches", -40, tmp_path / "matches.log")
    assert "matching photos ended by signal 40 (no message in the log)" in str(error)
    assert (
        "more memory than is available" in process._crash_error("matches", -signal.SIGKILL, tmp_path / "no.log").problem
    )
    assert process._crash_error("matches", -signal.SIGABRT, tmp_path / "matches.log").problem.count("by SIGABRT") == 1


def test_when_one_mapper_crashes_the_result_of_the_other_is_used_and_noted(
    photos_and_poses, stopped_after_matching, tmp_path, monkeypatch
):
    shutil.copytree(stopped_after_matching, tmp_path / "scene")
    (tmp_path / "sitecustomize.py").write_text(CRASH_AT_STAGE_CODE.format(stage="global"))
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    report = hyrfpack.estimate_poses(photos_and_poses[0], tmp_path / "scene")
    assert (report.mapper, report.registered, report.sure) == ("incremental", len(photos_and_poses[1]), 0)
    assert any("the global mapper failed" in note for note in report.notes)
    assert any("are not confirmed" in note for note in report.notes)


@pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")
@pytest.mark.parametrize("number, code", [(signal.SIGINT, 1), (signal.SIGKILL, -signal.SIGKILL)])
def test_a_signal_to_the_command_ends_its_worker(number, code, photos_and_poses, tmp_path, signals):
    command = [sys.executable, "-m", "hyrfpack", "poses", str(photos_and_poses[0]), "-o", str(tmp_path / "scene")]
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY_ROOT)}
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
        assert "the same command resumes from here" in errors
    deadline = time.monotonic() + 5
    while time.monotonic() < deadline and Path(f"/proc/{worker}").exists():
        time.sleep(0.05)
    assert not Path(f"/proc/{worker}").exists()

"""Folder locks let one call at a time work in a folder, across threads and processes."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
import threading
from multiprocessing import get_context
from pathlib import Path

import pytest

from hyrfpack import lock
from hyrfpack.errors import HyrfError
from hyrfpack.lock import exclusive_folder, try_lock

pytest.importorskip("fcntl", reason="locks are of Unix")
RACE_ROUNDS = 50
BUSY_FOLDER_ERROR = (
    "another hyrfpack command is at work in this folder; wait until it has ended, or name another folder"
)


def second_call_error(folder: Path) -> str:
    """Try to enter a locked folder and return the error."""
    with pytest.raises(HyrfError) as caught, exclusive_folder(folder):
        raise AssertionError("it was let in")
    return str(caught.value)


def lock_in_race(folder: Path, start, end, answers) -> None:
    """Compete for the same folders with the other process, round by round."""
    for number in range(RACE_ROUNDS):
        start.wait()
        try:
            with exclusive_folder(folder / str(number)):
                (folder / str(number) / "result").write_bytes(b"of one")
                end.wait()  # every other process has tried by then
            answers.put((number, "worked"))
        except HyrfError:
            end.wait()
            answers.put((number, "refused"))


def test_of_two_processes_that_race_for_a_folder_one_works_and_one_is_rejected_in_50_races(tmp_path):
    spawn = get_context("spawn")
    start, end, answers = spawn.Barrier(2), spawn.Barrier(2), spawn.Queue()
    racers = [spawn.Process(target=lock_in_race, args=(tmp_path, start, end, answers)) for _ in range(2)]
    for racer in racers:
        racer.start()
    found = sorted(answers.get() for _ in range(2 * RACE_ROUNDS))
    for racer in racers:
        racer.join()

    assert found == [(number, outcome) for number in range(RACE_ROUNDS) for outcome in ("refused", "worked")]


def test_a_second_call_is_a_clear_error_and_changes_nothing(tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "model.hyrf").write_bytes(b"a model")
    with exclusive_folder(tmp_path / "run"):
        assert second_call_error(tmp_path / "run") == f"{tmp_path / 'run'}: {BUSY_FOLDER_ERROR}"
        assert (tmp_path / "run" / "model.hyrf").read_bytes() == b"a model"


def test_folder_is_free_again_after_the_call_and_after_its_failure(tmp_path):
    for error in (None, ValueError()):
        try:
            with exclusive_folder(tmp_path):
                if error:
                    raise error
        except ValueError:
            pass
        with exclusive_folder(tmp_path):
            pass


def test_two_threads_of_one_process_exclude_each_other(tmp_path):
    messages = []
    with exclusive_folder(tmp_path):
        thread = threading.Thread(target=lambda: messages.append(second_call_error(tmp_path)))
        thread.start()
        thread.join()
    assert messages == [f"{tmp_path}: {BUSY_FOLDER_ERROR}"]


def test_another_name_of_the_same_folder_is_locked_too(tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "link").symlink_to("run")
    with exclusive_folder(tmp_path / "link"):
        assert BUSY_FOLDER_ERROR in second_call_error(tmp_path / "run")


def test_folders_in_a_locked_folder_are_free(tmp_path):
    with exclusive_folder(tmp_path), exclusive_folder(tmp_path / "run"):
        pass


def test_killed_process_leaves_no_lock(tmp_path):
    script = (
        "import sys, time\nfrom hyrfpack.lock import exclusive_folder\n"
        "with exclusive_folder(sys.argv[1]):\n    print('locked', flush=True)\n    time.sleep(600)\n"
    )
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])}
    command = [sys.executable, "-c", script, str(tmp_path)]
    with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout.readline() == "locked\n"
            assert BUSY_FOLDER_ERROR in second_call_error(tmp_path)
        finally:
            process.send_signal(signal.SIGKILL)
    with exclusive_folder(tmp_path):
        assert list(tmp_path.iterdir()) == []


def test_forked_process_does_not_keep_the_lock_of_a_call_that_has_ended(tmp_path):
    reading, writing = os.pipe()
    with exclusive_folder(tmp_path):
        child = os.fork()
        if child == 0:
            os.close(writing)
            os.read(reading, 1)  # until the parent closes its end
            os._exit(0)
    with exclusive_folder(tmp_path):
        pass
    os.close(writing)
    os.close(reading)
    os.waitpid(child, 0)


def test_folders_that_were_created_and_are_empty_at_the_end_are_removed(tmp_path):
    with exclusive_folder(tmp_path / "deep" / "run"):
        assert (tmp_path / "deep" / "run").is_dir()
    assert list(tmp_path.iterdir()) == []


def test_folders_with_a_result_and_folders_of_others_stay(tmp_path):
    (tmp_path / "empty").mkdir()
    with exclusive_folder(tmp_path / "empty"), exclusive_folder(tmp_path / "run"):
        (tmp_path / "run" / "model.hyrf").write_bytes(b"a model")
    assert (tmp_path / "empty").is_dir() and (tmp_path / "run" / "model.hyrf").is_file()


@pytest.mark.parametrize("why", ["system", "file system"])
def test_without_support_for_locks_both_calls_work(why, tmp_path, monkeypatch):
    def unsupported(*_):
        raise OSError(errno.ENOLCK, "No locks available")

    if why == "system":
        monkeypatch.setattr(lock, "fcntl", None)
    else:
        monkeypatch.setattr(lock.fcntl, "flock", unsupported)
    with exclusive_folder(tmp_path), exclusive_folder(tmp_path):
        pass


def test_folder_that_cannot_be_opened_for_reading_is_not_locked(tmp_path, monkeypatch):
    def forbidden(*_):
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(lock.os, "open", forbidden)
    with exclusive_folder(tmp_path):
        pass


def test_a_file_is_locked_once_at_a_time_and_stays(tmp_path):
    file = tmp_path / "blocks" / "1-1.lock"
    with try_lock(file) as is_first, try_lock(file) as is_second, try_lock(file.with_name("2-1.lock")) as is_other:
        assert (is_first, is_second, is_other) == (True, False, True)
    with try_lock(file) as is_free:
        assert is_free and file.is_file()


def test_a_file_lock_ends_when_its_process_is_killed(tmp_path):
    file = tmp_path / "1-1.lock"
    script = (
        "import sys, time, pathlib; from hyrfpack.lock import try_lock\n"
        "with try_lock(pathlib.Path(sys.argv[1])) as is_mine: print(is_mine, flush=True); time.sleep(60)"
    )
    with subprocess.Popen([sys.executable, "-c", script, file], stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout is not None and holder.stdout.readline() == "True\n"
        with try_lock(file) as is_mine:
            assert not is_mine
        holder.kill()
    with try_lock(file) as is_mine:
        assert is_mine


@pytest.mark.parametrize("system", ["Windows", "without locks"])
def test_a_file_lock_is_refused_where_it_would_not_exclude_anyone(tmp_path, monkeypatch, system):
    def refuse(handle: int, kind: int) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    if system == "Windows":
        monkeypatch.setattr(lock, "fcntl", None)
    else:
        monkeypatch.setattr("fcntl.flock", refuse)
    with pytest.raises(HyrfError, match="does not support locks.*or use one process"), try_lock(tmp_path / "x.lock"):
        raise AssertionError("it was let in")


def test_a_lock_file_that_cannot_be_made_is_one_clear_error(tmp_path):
    (tmp_path / "x.lock").mkdir()
    with pytest.raises(HyrfError, match="x.lock: the file cannot be opened"), try_lock(tmp_path / "x.lock"):
        raise AssertionError("it was let in")

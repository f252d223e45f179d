"""Atomic writing: a reader finds the old file or the new one, whatever happens in between."""

from __future__ import annotations

import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from hyrfpack.atomic import write_atomic
from hyrfpack.errors import HyrfError


def files_in(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize("old", [b"old", None])
def test_write_puts_the_bytes_there_and_leaves_nothing_else(tmp_path, old):
    path = tmp_path / "model.hyrf"
    if old is not None:
        path.write_bytes(old)

    write_atomic(path, memoryview(b"new bytes"))

    assert files_in(tmp_path) == {"model.hyrf": b"new bytes"}


def test_written_file_has_the_mode_of_an_ordinary_new_file(tmp_path):
    (tmp_path / "ordinary").write_bytes(b"")

    write_atomic(tmp_path / "model.hyrf", b"")

    assert stat.S_IMODE((tmp_path / "model.hyrf").stat().st_mode) == stat.S_IMODE(
        (tmp_path / "ordinary").stat().st_mode
    )


def test_write_follows_a_link(tmp_path):
    (tmp_path / "there").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "there" / "model.hyrf")

    write_atomic(tmp_path / "link", b"new")

    assert (tmp_path / "link").is_symlink() and files_in(tmp_path / "there") == {"model.hyrf": b"new"}


def test_write_takes_the_longest_name_the_folder_can_hold(tmp_path):
    name = "n" * 255

    write_atomic(tmp_path / name, b"new")

    assert files_in(tmp_path) == {name: b"new"}


@pytest.mark.parametrize("step", ["fsync", "replace"])
@pytest.mark.parametrize(
    "error", [OSError(28, "No space left on device"), OSError(5, "I/O error"), KeyboardInterrupt()]
)
def test_failure_leaves_the_old_file_and_no_temporary_one(tmp_path, monkeypatch, step, error):
    path = tmp_path / "model.hyrf"
    path.write_bytes(b"old")

    def fail(*_):
        raise error

    monkeypatch.setattr(os, step, fail)

    with pytest.raises(HyrfError if isinstance(error, OSError) else KeyboardInterrupt):
        write_atomic(path, b"new")

    assert files_in(tmp_path) == {"model.hyrf": b"old"}


def test_full_disk_is_one_sentence_with_the_bytes_needed(tmp_path, monkeypatch):
    def fail(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", fail)

    with pytest.raises(HyrfError, match="model.hyrf: the disk is full; free 1,234 bytes"):
        write_atomic(tmp_path / "model.hyrf", bytes(1234))


def test_write_that_stops_half_way_leaves_the_old_file(tmp_path):
    # A real short write: the process may not make files over 4096 bytes.
    resource = pytest.importorskip("resource")
    path = tmp_path / "model.hyrf"
    path.write_bytes(b"old")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, limits[1]))
    try:
        with pytest.raises(HyrfError, match="model.hyrf: the file cannot be written"):
            write_atomic(path, bytes(100_000))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)

    assert files_in(tmp_path) == {"model.hyrf": b"old"}


@pytest.mark.skipif(os.name == "nt", reason="needs SIGKILL")
@pytest.mark.parametrize(("step", "expected"), [("fsync", b"old"), ("replace", b"old"), ("_sync_folder", b"new" * 999)])
def test_process_killed_at_a_step_leaves_one_whole_file(tmp_path, step, expected):
    path = tmp_path / "model.hyrf"
    path.write_bytes(b"old")
    script = (
        "import os, signal, sys\n"
        "from hyrfpack import atomic\n"
        f"owner = atomic if '{step}'.startswith('_') else os\n"
        f"setattr(owner, '{step}', lambda *_: os.kill(os.getpid(), signal.SIGKILL))\n"
        "atomic.write_atomic(sys.argv[1], b'new' * 999)\n"
    )
    root = Path(__file__).parents[2]

    done = subprocess.run(
        [sys.executable, "-c", script, path], env={**os.environ, "PYTHONPATH": str(root)}, check=False
    )

    assert done.returncode == -9
    assert path.read_bytes() == expected


def test_missing_folder_is_named(tmp_path):
    with pytest.raises(HyrfError, match="there is no folder '.*absent'; make it first"):
        write_atomic(tmp_path / "absent" / "model.hyrf", b"new")


def test_folder_in_the_way_is_named(tmp_path):
    (tmp_path / "model.hyrf").mkdir()

    with pytest.raises(HyrfError, match="model.hyrf: this is a folder"):
        write_atomic(tmp_path / "model.hyrf", b"new")

    assert list(tmp_path.iterdir()) == [tmp_path / "model.hyrf"]


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write anywhere")
def test_folder_without_permission_is_one_sentence(tmp_path):
    tmp_path.chmod(0o555)
    try:
        with pytest.raises(HyrfError, match="Permission denied"):
            write_atomic(tmp_path / "model.hyrf", b"new")
    finally:
        tmp_path.chmod(0o755)

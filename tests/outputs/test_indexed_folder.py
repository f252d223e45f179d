"""Files of an indexed folder are replaced together, or not at all."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from hyrfpack import atomic
from hyrfpack.errors import HyrfError
from hyrfpack.outputs.indexed_folder import IndexedFolder


def read_files(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def write_old(folder: Path) -> dict[str, bytes]:
    with IndexedFolder(folder, "index", overwrite=True) as output:
        output.write("a/1", b"old 1")
        output.write("index", b"old")
    return read_files(folder)


def test_old_files_are_there_until_all_new_ones_are_written(tmp_path):
    old = write_old(tmp_path)
    (tmp_path / "source").write_bytes(b"copied")

    with IndexedFolder(tmp_path, "index", overwrite=True) as output:
        output.write("a/1", b"new 1")
        output.copy("b/2", tmp_path / "source")
        output.write("index", b"new")
        assert {name: (tmp_path / name).read_bytes() for name in old} == old
        assert not (tmp_path / "b").exists()

    assert output.bytes == len(b"new 1copiednew")
    assert read_files(tmp_path) == {"a/1": b"new 1", "b/2": b"copied", "index": b"new", "source": b"copied"}


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_an_error_before_the_end_leaves_the_folder_as_it_was(tmp_path, error):
    old = write_old(tmp_path)

    with pytest.raises(error), IndexedFolder(tmp_path, "index", overwrite=True) as output:
        output.write("a/1", b"new 1")
        output.write("b/2", b"new 2")
        raise error

    assert read_files(tmp_path) == old and sorted(os.listdir(tmp_path)) == ["a", "index"]


@pytest.mark.parametrize("failing", ["a/1", "b/2", "index"])
def test_a_failed_move_leaves_the_folder_as_it_was(failing, tmp_path, monkeypatch):
    old = write_old(tmp_path)
    replace = os.replace

    def fail(source, target):
        if Path(target) == tmp_path / failing:
            raise OSError(5, "Input/output error")
        replace(source, target)

    monkeypatch.setattr("hyrfpack.atomic.os.replace", fail)
    with pytest.raises(HyrfError, match=f"{failing}: the file cannot be written"):
        with IndexedFolder(tmp_path, "index", overwrite=True) as output:
            for name in ("a/1", "b/2", "index"):
                output.write(name, b"new")

    assert read_files(tmp_path) == old and sorted(os.listdir(tmp_path)) == ["a", "index"]


def test_without_overwrite_an_existing_file_is_kept_and_nothing_new_stays(tmp_path):
    old = write_old(tmp_path)

    with pytest.raises(HyrfError, match="index: another program created this file"):
        with IndexedFolder(tmp_path, "index", overwrite=False) as output:
            output.write("b/2", b"new 2")
            output.write("index", b"new")

    assert read_files(tmp_path) == old and not (tmp_path / "b").exists()


@pytest.mark.skipif(os.name == "nt", reason="needs symbolic links")
def test_the_target_of_a_link_is_replaced(tmp_path):
    (tmp_path / "real").write_bytes(b"old")
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "index").symlink_to(tmp_path / "real")

    with IndexedFolder(tmp_path / "folder", "index", overwrite=True) as output:
        output.write("index", b"new")

    assert (tmp_path / "real").read_bytes() == b"new" and (tmp_path / "folder" / "index").is_symlink()


@pytest.mark.integration
@pytest.mark.skipif(atomic.fcntl is None, reason="needs the locks of Unix")
def test_the_next_call_removes_the_files_of_a_killed_process_and_none_of_a_running_one(tmp_path):
    old = write_old(tmp_path)
    script = (
        "import os, signal, sys\n"
        "from pathlib import Path\n"
        "from hyrfpack.outputs.indexed_folder import IndexedFolder\n"
        "with IndexedFolder(Path(sys.argv[1]), 'index', True) as output:\n"
        "    output.write('a/1', b'new')\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    root = Path(__file__).parents[2]
    command = [sys.executable, "-c", script, tmp_path]
    code = subprocess.run(command, env={**os.environ, "PYTHONPATH": str(root)}, check=False).returncode
    assert code == -signal.SIGKILL and len(os.listdir(tmp_path)) == 3 and read_files(tmp_path).items() > old.items()

    with IndexedFolder(tmp_path, "index", overwrite=True) as first:
        first.write("index", b"first")
        assert len(os.listdir(tmp_path)) == 3
        with IndexedFolder(tmp_path, "index", overwrite=True) as second:
            second.write("index", b"second")

    assert read_files(tmp_path) == {**old, "index": b"first"}

"""Atomic writing: a reader finds the old file or the new one, whatever happens in between."""

from __future__ import annotations

import errno
import io
import os
import re
import stat
import subprocess
import sys
from itertools import islice
from multiprocessing import get_context
from pathlib import Path

import pytest

from hyrfpack import atomic
from hyrfpack.atomic import numbered_names, replace_file, write_atomic
from hyrfpack.errors import HyrfError


def files_in(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize("old", [b"old", None])
def test_write_creates_the_file_and_leaves_no_other_file(tmp_path, old):
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


def test_write_accepts_the_longest_name_that_the_folder_can_hold(tmp_path):
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


@pytest.mark.parametrize(
    ("number", "sentence"),
    [
        (errno.ENOSPC, "the disk is full and this file was not written; free 1,234 bytes and try again"),
        (errno.EDQUOT, "your quota is used up and this file was not written; free 1,234 bytes and try again"),
        (errno.EIO, "the file cannot be written (Input/output error); choose another place or repair this one"),
        (errno.EROFS, "the file cannot be written (Read-only file system); choose another place or repair this one"),
    ],
)
def test_a_full_or_failing_disk_is_a_clear_error(tmp_path, monkeypatch, number, sentence):
    def fail(_):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "fsync", fail)

    with pytest.raises(HyrfError, match=re.escape(f"model.hyrf: {sentence}") + "$"):
        write_atomic(tmp_path / "model.hyrf", bytes(1234))

    assert files_in(tmp_path) == {}


def test_an_incomplete_write_leaves_the_old_file(tmp_path):
    # The limit causes a real short write: the process may not create files of more than 4096 bytes.
    resource = pytest.importorskip("resource")
    path = tmp_path / "model.hyrf"
    path.write_bytes(b"old")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, limits[1]))
    try:
        with pytest.raises(HyrfError, match="model.hyrf: so large a file is not allowed here"):
            write_atomic(path, bytes(100_000))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)

    assert files_in(tmp_path) == {"model.hyrf": b"old"}


@pytest.mark.skipif(os.name == "nt", reason="needs SIGKILL")
@pytest.mark.parametrize(("step", "expected"), [("fsync", b"old"), ("replace", b"old"), ("_sync_folder", b"new" * 999)])
def test_a_process_killed_at_any_step_leaves_one_complete_file(tmp_path, step, expected):
    path = tmp_path / "model.hyrf"
    path.write_bytes(b"old")
    script = (
        "import os, signal, sys\n"
        "from hyrfpack import atomic\n"
        f"owner = atomic if '{step}'.startswith('_') else os\n"
        f"setattr(owner, '{step}', lambda *_: os.kill(os.getpid(), signal.SIGKILL))\n"
        "atomic.write_atomic(sys.argv[1], b'new' * 999)\n"
    )
    root = Path(__file__).parents[1]

    done = subprocess.run(
        [sys.executable, "-c", script, path], env={**os.environ, "PYTHONPATH": str(root)}, check=False
    )

    assert done.returncode == -9
    assert path.read_bytes() == expected
    litter = [name for name in files_in(tmp_path) if name != "model.hyrf"]
    assert len(litter) == (expected == b"old") and all(re.fullmatch(r"\.hyrfpack-\w+\.tmp", name) for name in litter)
    write_atomic(tmp_path / "another", b"next")  # the next writer in the folder removes the temporary file
    assert files_in(tmp_path) == {"model.hyrf": expected, "another": b"next"}


# -- several writers -------------------------------------------------------------------------------------------------

needs_locks = pytest.mark.skipif(atomic.fcntl is None, reason="needs the locks of Unix")


@needs_locks
def test_the_temporary_file_of_a_live_writer_is_kept(tmp_path):
    with replace_file(tmp_path / "slow") as temporary:
        temporary.write_bytes(b"half")
        write_atomic(tmp_path / "quick", b"whole")
        assert temporary.read_bytes() == b"half"

    assert files_in(tmp_path) == {"slow": b"half", "quick": b"whole"}


@needs_locks
def test_a_folder_without_locks_keeps_temporary_files_and_can_be_written(tmp_path, monkeypatch):
    def unsupported(*_):
        raise OSError(errno.ENOLCK, "No locks available")

    (tmp_path / ".hyrfpack-0.tmp").write_bytes(b"perhaps somebody's")
    monkeypatch.setattr(atomic.fcntl, "flock", unsupported)

    write_atomic(tmp_path / "model.hyrf", b"new")

    assert files_in(tmp_path) == {".hyrfpack-0.tmp": b"perhaps somebody's", "model.hyrf": b"new"}


def test_a_system_without_locks_keeps_temporary_files_and_can_be_written(tmp_path, monkeypatch):
    (tmp_path / ".hyrfpack-0.tmp").write_bytes(b"perhaps somebody's")
    monkeypatch.setattr(atomic, "fcntl", None)

    write_atomic(tmp_path / "model.hyrf", b"new")

    assert files_in(tmp_path) == {".hyrfpack-0.tmp": b"perhaps somebody's", "model.hyrf": b"new"}


@needs_locks
def test_a_temporary_file_removed_before_it_was_locked_is_created_again(tmp_path, monkeypatch):
    taken = []

    def steal_the_first(descriptor, operation):
        if not taken:
            taken.extend(tmp_path.glob(".hyrfpack-*"))
            taken[0].unlink()

    monkeypatch.setattr(atomic.fcntl, "flock", steal_the_first)

    with replace_file(tmp_path / "model.hyrf") as temporary:
        assert len(taken) == 1 and temporary not in taken and temporary.exists()
        temporary.write_bytes(b"new")

    assert files_in(tmp_path) == {"model.hyrf": b"new"}


@needs_locks
def test_simultaneous_writers_of_one_file_never_mix_their_bytes(tmp_path):
    """Four processes write one file and look for temporary files. A reader always finds one complete version."""
    path, rounds, length = tmp_path / "model.hyrf", 60, 100_000
    path.write_bytes(b"0" * length)
    script = (
        "import sys\n"
        "from hyrfpack.atomic import write_atomic\n"
        f"for _ in range({rounds}): write_atomic(sys.argv[1], sys.argv[2].encode() * {length})\n"
    )
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])}
    writers = [
        subprocess.Popen([sys.executable, "-c", script, path, letter], env=environment, stderr=subprocess.PIPE)
        for letter in "abcd"
    ]

    seen = set()
    while any(writer.poll() is None for writer in writers):
        data = path.read_bytes()
        seen.add(data[:1])
        assert data == data[:1] * length

    assert [writer.communicate()[1].decode() for writer in writers] == [""] * 4
    assert [writer.returncode for writer in writers] == [0] * 4
    assert len(seen) > 1 and files_in(tmp_path).keys() == {"model.hyrf"}


# -- nothing is replaced unless overwriting is allowed ----------------------------------------------------------------

RACE_ROUNDS = 50


@pytest.fixture(params=["hard links", "no hard links"])
def file_system(request, monkeypatch) -> None:
    """The file system with hard links, and without them as on FAT."""

    def unsupported(*_, **__):
        raise PermissionError(errno.EPERM, "Operation not permitted")

    if request.param == "no hard links":
        monkeypatch.setattr(os, "link", unsupported)


@pytest.mark.usefixtures("file_system")
def test_without_overwrite_a_new_file_gets_the_requested_name(tmp_path):
    assert write_atomic(tmp_path / "model.hyrf", b"new", overwrite=False) == tmp_path / "model.hyrf"

    assert files_in(tmp_path) == {"model.hyrf": b"new"}


@pytest.mark.usefixtures("file_system")
def test_without_overwrite_an_existing_file_is_kept_and_the_first_free_name_is_used(tmp_path):
    (tmp_path / "model.hyrf").write_bytes(b"old")
    (tmp_path / "model-2.hyrf").write_bytes(b"older")

    assert write_atomic(tmp_path / "model.hyrf", b"new", overwrite=False) == tmp_path / "model-3.hyrf"

    assert files_in(tmp_path) == {"model.hyrf": b"old", "model-2.hyrf": b"older", "model-3.hyrf": b"new"}


@pytest.mark.usefixtures("file_system")
def test_without_overwrite_a_file_created_while_writing_is_kept(tmp_path):
    with atomic.pending_file(tmp_path / "model.hyrf", overwrite=False) as pending:
        pending.temporary.write_bytes(b"new")
        (tmp_path / "model.hyrf").write_bytes(b"of another program")

    assert pending.path == tmp_path / "model-2.hyrf"
    assert files_in(tmp_path) == {"model.hyrf": b"of another program", "model-2.hyrf": b"new"}


@pytest.mark.usefixtures("file_system")
def test_without_overwrite_and_rename_a_file_created_while_writing_is_an_error(tmp_path):
    with (
        pytest.raises(
            HyrfError, match="index.html: another program created this file in the meantime.* `overwrite=True`"
        ),
        atomic.pending_file(tmp_path / "index.html", overwrite=False, rename=False) as pending,
    ):
        pending.temporary.write_bytes(b"new")
        (tmp_path / "index.html").write_bytes(b"of another program")

    assert files_in(tmp_path) == {"index.html": b"of another program"}


@pytest.mark.usefixtures("file_system")
@pytest.mark.parametrize("kind", ["folder", "dangling link", "link to a file"])
def test_without_overwrite_anything_with_the_same_name_is_kept(kind, tmp_path):
    (tmp_path / "other").write_bytes(b"old")
    path = tmp_path / "model.hyrf"
    if kind == "folder":
        path.mkdir()
    else:
        path.symlink_to("nowhere" if kind == "dangling link" else "other")

    assert write_atomic(path, b"new", overwrite=False) == tmp_path / "model-2.hyrf"

    assert (tmp_path / "other").read_bytes() == b"old" and (tmp_path / "model-2.hyrf").read_bytes() == b"new"
    assert path.is_dir() if kind == "folder" else path.is_symlink()
    assert not (tmp_path / "nowhere").exists()


def test_without_overwrite_a_relative_path_is_returned_as_a_relative_path(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "model.hyrf").write_bytes(b"old")

    assert str(write_atomic("model.hyrf", b"new", overwrite=False)) == "model-2.hyrf"


@pytest.mark.parametrize(
    ("name", "second"),
    [
        ("scene.hyrf", "scene-2.hyrf"),
        ("scene.points.ply", "scene-2.points.ply"),
        ("scene.points.glb", "scene-2.points.glb"),
        ("drone 2024.05.01.hyrf", "drone 2024.05.01-2.hyrf"),
        ("no suffix", "no suffix-2"),
        (".hidden", ".hidden-2"),
        (".hidden.hyrf", ".hidden-2.hyrf"),
        ("a." + "b" * 253, "a." + "b" * 251 + "-2"),
        ("\u00fc" * 125 + ".hyrf", "\u00fc" * 124 + "-2.hyrf"),  # 255 bytes, because each letter takes two
    ],
)
def test_a_free_name_keeps_the_whole_suffix_and_fits_into_a_folder(name, second, tmp_path):
    first, found = islice(numbered_names(tmp_path / name), 2)
    assert (first, found) == (tmp_path / name, tmp_path / second)
    (tmp_path / name).write_bytes(b"old")

    assert write_atomic(tmp_path / name, b"new", overwrite=False) == tmp_path / second


def test_a_claimed_name_is_released_when_the_file_cannot_be_moved_there(tmp_path, monkeypatch):
    """File systems without hard links claim a name by an empty file."""

    def fail(*_):
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(os, "link", fail)
    monkeypatch.setattr(os, "replace", fail)

    with pytest.raises(HyrfError, match="model.hyrf: the file cannot be written"):
        write_atomic(tmp_path / "model.hyrf", b"new", overwrite=False)

    assert files_in(tmp_path) == {}


@pytest.mark.skipif(os.name == "nt", reason="needs SIGKILL")
@pytest.mark.parametrize(("step", "whole"), [("fsync", False), ("link", False), ("after link", True)])
def test_a_process_killed_while_naming_a_file_leaves_a_complete_file_or_none(tmp_path, step, whole):
    script = (
        "import os, signal, sys\n"
        "from hyrfpack.atomic import write_atomic\n"
        "kill, link = lambda *_: os.kill(os.getpid(), signal.SIGKILL), os.link\n"
        f"step = '{step}'\n"
        "if step == 'after link': os.link = lambda *names: (link(*names), kill())\n"
        "else: setattr(os, step, kill)\n"
        "write_atomic(sys.argv[1], b'new' * 999, overwrite=False)\n"
    )
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])}

    done = subprocess.run([sys.executable, "-c", script, tmp_path / "model.hyrf"], env=environment, check=False)

    assert done.returncode == -9
    write_atomic(tmp_path / "another", b"next")  # the next writer in the folder removes the temporary file
    assert files_in(tmp_path) == {"another": b"next", **({"model.hyrf": b"new" * 999} if whole else {})}


def write_in_race(folder: Path, letter: bytes, start, answers) -> None:
    """Write the same names as the other process, round by round."""
    for number in range(RACE_ROUNDS):
        start.wait()
        answers.put((number, write_atomic(folder / f"{number}.hyrf", letter * 1000, overwrite=False).name))


def test_two_processes_that_write_one_name_without_overwrite_keep_both_results_in_50_races(tmp_path):
    spawn = get_context("spawn")
    start, answers = spawn.Barrier(2), spawn.Queue()
    racers = [spawn.Process(target=write_in_race, args=(tmp_path, letter, start, answers)) for letter in (b"a", b"b")]
    for racer in racers:
        racer.start()
    messages = sorted(answers.get() for _ in range(2 * RACE_ROUNDS))
    for racer in racers:
        racer.join()

    assert messages == sorted((number, f"{number}{end}.hyrf") for number in range(RACE_ROUNDS) for end in ("", "-2"))
    files = files_in(tmp_path)
    assert files.keys() == {name for _, name in messages}
    for number in range(RACE_ROUNDS):
        assert {files[f"{number}.hyrf"], files[f"{number}-2.hyrf"]} == {b"a" * 1000, b"b" * 1000}


# -- places that cannot hold a file ----------------------------------------------------------------------------------


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
def test_a_pipe_is_rejected_also_behind_a_link(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to(tmp_path / "pipe")

    for name in ("pipe", "link"):
        with pytest.raises(HyrfError, match=f"{name}: this is a device or a pipe; name a file"):
            write_atomic(tmp_path / name, b"new")

    assert stat.S_ISFIFO((tmp_path / "pipe").stat().st_mode)


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="there is no /dev/full")
def test_a_device_is_rejected_and_stays_in_place():
    with pytest.raises(HyrfError, match="/dev/full: this is a device or a pipe; name a file"):
        write_atomic("/dev/full", b"new")

    assert stat.S_ISCHR(os.stat("/dev/full").st_mode)


def test_working_folder_that_was_removed_is_a_clear_error(tmp_path, monkeypatch):
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()

    with pytest.raises(HyrfError, match="model.hyrf: the file cannot be written .No such file or directory"):
        write_atomic("model.hyrf", b"new")


def test_a_failed_write_releases_its_bytes(tmp_path):
    buffer = io.BytesIO(b"new")

    with pytest.raises(HyrfError) as kept:  # the traceback's frames hold references to the bytes
        write_atomic(tmp_path, buffer.getbuffer())

    buffer.close()  # BufferError while there is a view of it
    assert kept.value


def test_missing_folders_are_created(tmp_path):
    write_atomic(tmp_path / "absent" / "too" / "model.hyrf", b"new")

    assert (tmp_path / "absent" / "too" / "model.hyrf").read_bytes() == b"new"


def test_a_file_in_place_of_a_folder_is_named_in_the_error(tmp_path):
    (tmp_path / "photos").write_bytes(b"")

    with pytest.raises(HyrfError, match="photos: the folder cannot be made"):
        write_atomic(tmp_path / "photos" / "model.hyrf", b"new")


def test_a_folder_with_the_name_of_the_file_is_named_in_the_error(tmp_path):
    (tmp_path / "model.hyrf").mkdir()

    with pytest.raises(HyrfError, match="model.hyrf: this is a folder"):
        write_atomic(tmp_path / "model.hyrf", b"new")

    assert list(tmp_path.iterdir()) == [tmp_path / "model.hyrf"]


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write anywhere")
def test_folder_without_permission_is_a_clear_error(tmp_path):
    tmp_path.chmod(0o555)
    try:
        with pytest.raises(HyrfError, match="Permission denied"):
            write_atomic(tmp_path / "model.hyrf", b"new")
    finally:
        tmp_path.chmod(0o755)

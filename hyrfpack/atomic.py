"""Files appear whole or not at all."""

from __future__ import annotations

import contextlib
import errno
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from hyrfpack.errors import HyrfError

try:
    import fcntl
except ModuleNotFoundError:  # Windows
    fcntl = None  # type: ignore[assignment]

PREFIX, SUFFIX = ".hyrfpack-", ".tmp"  # of temporary files; what is between is random


def write_atomic(path: str | os.PathLike[str], data: bytes | memoryview) -> None:
    """Put `data` at `path` in one step: at any moment, a crash included, readers find the old file or the new one.

    Of several writers at once the last one wins. Details and errors as `replacing`.
    """
    # The view is let go of in any case: that of a BytesIO, kept by the traceback of a failure, crashes Python 3.12.1
    # when garbage is collected.
    with memoryview(data) as view:
        del data
        with replacing(path, view.nbytes) as temporary, open(temporary, "wb") as file:
            file.write(view)


@contextmanager
def replacing(path: str | os.PathLike[str], length: int | None = None) -> Iterator[Path]:
    """A temporary path to write to, beside `path`; its file takes the name `path` when the block ends.

    The bytes are forced to the disk before they take the name. A link at `path` stays and its target is replaced. When
    anything fails, an interrupt included, the old file is untouched and the temporary one is removed. What a killed
    process left behind is removed by the next one that writes into the same folder (but on Windows).

    Args:
        path: of the file; its folder is made if missing.
        length: bytes that will be written, for the message when the disk is full.

    Raises:
        HyrfError: the folder cannot be made, is not writable or full, or what is at `path` is no file. An OSError in
            the block counts as one of writing.
    """
    try:
        make_folder(Path(os.path.realpath(path)).parent)
        if os.path.exists(path) and not os.path.isfile(path):
            kind = "folder; name a file in it" if os.path.isdir(path) else "device or a pipe; name a file"
            raise HyrfError(f"{path}: this is a {kind}")
        target = Path(os.path.realpath(path))
        with _temporary_file(target.parent) as temporary:
            yield temporary
            with open(temporary, "rb+") as file:
                os.fsync(file.fileno())
            os.replace(temporary, target)
        _sync_folder(target.parent)
    except OSError as error:
        raise HyrfError(_explain(path, length, error)) from error


def make_folder(path: Path) -> None:
    """Make a folder and those above it. Raises HyrfError when that cannot be done."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise HyrfError(
            f"{path}: the folder cannot be made ({error.strerror or error}); choose another place"
        ) from error


def check_writable(folder: Path) -> None:
    """Raises HyrfError when no file can be made in a folder: better before hours of work than after."""
    try:
        with _temporary_file(folder):
            pass
    except OSError as error:
        raise HyrfError(
            f"{folder}: no file can be made in this folder ({error.strerror or error}); choose another place"
        ) from error


@contextmanager
def _temporary_file(folder: Path) -> Iterator[Path]:
    """A new, empty file, removed at the end if it is still there. Removes litter first."""
    _remove_litter(folder)
    temporary, lock = _claim(folder)
    try:
        yield temporary
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        if lock is not None:
            os.close(lock)


def _claim(folder: Path) -> tuple[Path, int | None]:
    """A new temporary file and the descriptor that holds its lock: to others it says that the writer lives."""
    while True:
        temporary = folder / f"{PREFIX}{secrets.token_hex(6)}{SUFFIX}"
        # Made by hand rather than through tempfile, which would make the file private (mode 0600).
        lock = os.open(temporary, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
        if fcntl is None:  # a file that is open cannot be renamed there
            os.close(lock)
            return temporary, None
        with contextlib.suppress(OSError):  # where locks are unknown (some network folders) litter stays
            fcntl.flock(lock, fcntl.LOCK_EX)
        if temporary.exists():
            return temporary, lock
        os.close(lock)  # in the moment before the lock, another process took the file for litter


def _remove_litter(folder: Path) -> None:
    """Remove the temporary files of killed processes: those whose lock is free."""
    if fcntl is None:
        return
    try:
        names = os.listdir(folder)
    except OSError:  # it may be written and not read, or is not there
        return
    for name in names:
        if name.startswith(PREFIX) and name.endswith(SUFFIX):
            with contextlib.suppress(OSError):
                lock = os.open(folder / name, os.O_RDWR)
                try:
                    fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    os.unlink(folder / name)
                finally:
                    os.close(lock)


def _sync_folder(folder: Path) -> None:
    """Make the new name survive a power cut. Windows and some network folders cannot; the file is whole there too."""
    with contextlib.suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def _explain(path: str | os.PathLike[str], length: int | None, error: OSError) -> str:
    size = "some space" if length is None else f"{length:,} bytes"
    if error.errno == errno.ENOSPC:
        return f"{path}: the disk is full and this file was not written; free {size} and try again"
    if error.errno == errno.EDQUOT:
        return f"{path}: your quota is used up and this file was not written; free {size} and try again"
    if error.errno == errno.EFBIG:
        return f"{path}: so large a file is not allowed here (see 'ulimit -f'); choose another place"
    return f"{path}: the file cannot be written ({error.strerror or error}); choose another place or repair this one"

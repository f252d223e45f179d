"""Lock folders, so that only one call at a time writes into a folder, and files, which stand for pieces of work."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from hyrfpack.atomic import make_folder
from hyrfpack.errors import HyrfError

if TYPE_CHECKING:
    from hyrfpack.parallel.ranks import Ranks

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]


@contextmanager
def exclusive_folder(
    folder: str | os.PathLike[str], remedy: str = "another folder", ranks: Ranks | None = None
) -> Iterator[None]:
    """Create a folder and lock it, so that no other call of hyrfpack writes into it at the same time.

    The lock is an `flock` on the folder itself. The kernel releases it when the process ends, even if it is killed, so
    no lock is ever left behind. Every call opens the folder for itself, so calls in two threads of one process exclude
    each other as two processes do. A call must therefore not lock a folder that it holds already. If the system does
    not support such locks (Windows, some network file systems), nothing is locked.

    Folders that are created here and are still empty at the end are removed.

    Args:
        folder: the folder to write into.
        remedy: what the user can name instead, for the message: "another folder with `work`".
        ranks: processes that work together, all of which call this. The main process holds the lock; if it cannot
            get the lock, all of them raise the error.

    Raises:
        HyrfError: another call is working in the folder, or the folder cannot be created.
    """
    folder = Path(folder)
    if ranks is not None and not ranks.is_main:
        ranks.run_on_all(lambda: None)
        yield
        return
    created = [path for path in (folder, *folder.parents) if not os.path.lexists(path)]  # deepest first, for rmdir
    handle = _lock(folder, remedy) if ranks is None else ranks.run_on_all(lambda: _lock(folder, remedy))
    try:
        yield
    finally:
        with suppress(OSError):  # A folder that is not empty stays, because rmdir fails.
            for path in created:
                path.rmdir()
        if handle is not None:
            with suppress(OSError):  # This file system may have no locks.
                # If the folder were only closed, a process that was forked in the meantime would keep the lock.
                fcntl.flock(handle, fcntl.LOCK_UN)
            os.close(handle)


@contextmanager
def try_lock(file: Path) -> Iterator[bool]:
    """Lock a file while the `with` block runs, and yield True; yield False if another process holds the lock.

    The file is created if it is missing, and stays. The kernel releases the lock when the process ends. On NFS, the
    lock of a file that is open for writing also excludes processes of other machines; that of a folder does not.

    Raises:
        HyrfError: the file cannot be created, or the system does not support such locks.
    """
    make_folder(file.parent)
    try:
        handle = os.open(file, os.O_RDWR | os.O_CREAT, 0o666)
    except OSError as error:
        raise HyrfError(
            f"{file}: the file cannot be opened ({error.strerror or error})", fix="choose another place"
        ) from error
    try:
        yield _try_to_lock_file(file, handle)
    finally:
        with suppress(OSError, AttributeError):  # This system may have no locks.
            fcntl.flock(handle, fcntl.LOCK_UN)  # for the reason in `exclusive_folder`
        os.close(handle)


def _try_to_lock_file(file: Path, handle: int) -> bool:
    """Lock an open file; return False if another process holds the lock."""
    try:
        if fcntl is None:
            raise OSError("Windows has none")
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        raise HyrfError(
            f"{file}: this file system does not support locks ({error.strerror or error})",
            fix="choose another place, or use one process",
        ) from error
    return True


def _lock(folder: Path, remedy: str) -> int | None:
    """Create a folder, lock it and return the descriptor that holds the lock; None if it cannot be locked."""
    while True:
        make_folder(folder)
        if fcntl is None:
            return None
        try:
            handle = os.open(folder, os.O_RDONLY)
        except FileNotFoundError:  # Another call removed the folder at its end, so it is created again.
            continue
        except OSError:  # A folder may be writable and not readable.
            return None
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(handle)
            raise HyrfError(
                f"{folder}: another hyrfpack command is at work in this folder",
                fix=f"wait until it has ended, or name {remedy}",
            ) from None
        except OSError:  # This file system has no locks.
            return handle
        with suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(handle), os.stat(folder)):
                return handle
        os.close(handle)  # Another call removed the folder between opening and locking.

"""A folder that one call works in at a time."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from hyrfpack.atomic import make_folder
from hyrfpack.errors import HyrfError

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]


@contextmanager
def held(folder: Path, command: str, other: str) -> Iterator[None]:
    """Make a folder and keep other calls out of it, where the system can: Windows and some network folders cannot.

    Folders that are made for it and are empty at the end are removed again.

    Args:
        folder: to work in.
        command: what works there, for the message.
        other: what else the person can name, for the message: "another with --work".

    Raises:
        HyrfError: another call is at work there, or the folder cannot be made.
    """
    new = [path for path in (folder, *folder.parents) if not os.path.lexists(path)]  # the deepest first
    handle = _lock(folder, f"{folder}: another '{command}' is at work in this folder; wait for it, or name {other}")
    try:
        yield
    finally:
        with suppress(OSError):  # something is in it
            for path in new:
                path.rmdir()
        if handle is not None:
            os.close(handle)


def _lock(folder: Path, busy: str) -> int | None:
    """The descriptor that holds a folder's lock; None where there are no locks."""
    while True:
        make_folder(folder)
        if fcntl is None:
            return None
        with suppress(FileNotFoundError):  # another call has ended and removed it, here or before it is locked
            handle = os.open(folder, os.O_RDONLY)
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                os.close(handle)
                raise HyrfError(busy) from None
            except OSError:  # locks are unknown there
                return handle
            with suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(handle), os.stat(folder)):
                    return handle
            os.close(handle)

"""Copies of the user's photos and masks that share their disk space where the file system can do that."""

from __future__ import annotations

import os
import shutil
from contextlib import suppress
from pathlib import Path

_FICLONE = 0x40049409  # ioctl of Linux: make this file share all blocks of another


def copy_file(source: Path, target: Path) -> None:
    """Copy a file with its times and permissions, so that an edit of one never changes the other.

    On Linux file systems with reflinks (Btrfs, XFS, bcachefs) the copy shares the blocks of its source until one of the
    two is changed, and takes no space before. Elsewhere all bytes are copied.

    Args:
        source: the file; links are followed.
        target: is created.

    Raises:
        OSError: the source cannot be read, or the target cannot be written.
    """
    source = Path(os.path.realpath(source))
    if not _reflink(source, target):
        shutil.copyfile(source, target)
    with suppress(OSError):  # not every file system keeps them
        shutil.copystat(source, target)


def _reflink(source: Path, target: Path) -> bool:
    """Whether the target is now a reflink of the source; where that is impossible, it may be left as an empty file."""
    try:
        import fcntl
    except ModuleNotFoundError:  # not on Windows
        return False
    with source.open("rb") as reading, target.open("wb") as writing:
        try:
            fcntl.ioctl(writing.fileno(), _FICLONE, reading.fileno())
        except OSError:  # another file system, one without reflinks, or another system than Linux
            return False
    return True

"""Copies of files, which share the disk space of the originals if the file system supports it."""

from __future__ import annotations

import os
import shutil
from contextlib import suppress
from pathlib import Path

_FICLONE = 0x40049409  # ioctl request of Linux (linux/fs.h) that makes a file share all blocks of another file


def copy_file(source: Path, target: Path, *, keep_metadata: bool = False) -> None:
    """Copy a file; later edits of one file never change the other.

    On Linux file systems with reflinks (Btrfs, XFS, bcachefs) the copy shares the blocks of its source. It takes no
    space until one of the two is changed. Elsewhere all bytes are copied.

    Args:
        source: file to copy; links are followed.
        target: path of the copy, which is created or overwritten.
        keep_metadata: give the copy the times and permissions of the source.

    Raises:
        OSError: the source cannot be read, or the target cannot be written.
        shutil.SameFileError: both paths lead to the same file, which stays as it is.
    """
    source = Path(os.path.realpath(source))
    if target.exists() and source.samefile(target):
        raise shutil.SameFileError(f"{source} and {target} are the same file")
    if not _reflink(source, target):
        shutil.copyfile(source, target)
    if keep_metadata:
        with suppress(OSError):  # some file systems keep neither times nor permissions
            shutil.copystat(source, target)


def _reflink(source: Path, target: Path) -> bool:
    """Make the target a reflink of the source; return False if that is impossible, which may leave an empty target."""
    try:
        import fcntl
    except ModuleNotFoundError:  # Windows has no fcntl
        return False
    with source.open("rb") as reading, target.open("wb") as writing:
        try:
            fcntl.ioctl(writing.fileno(), _FICLONE, reading.fileno())
        except OSError:  # two file systems, one without reflinks, or no Linux
            return False
    return True

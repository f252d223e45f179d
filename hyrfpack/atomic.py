"""Write files atomically: a file appears complete under its name, or not at all."""

from __future__ import annotations

import contextlib
import errno
import itertools
import os
import re
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from hyrfpack.errors import HyrfError

try:
    import fcntl
except ModuleNotFoundError:  # Windows
    fcntl = None  # type: ignore[assignment]

# A temporary file's name is this prefix, random digits and this suffix.
TEMPORARY_PREFIX = ".hyrfpack-"
TEMPORARY_SUFFIX = ".tmp"
MAX_NAME_BYTES = 255  # This is the limit of common file systems.
_SUFFIX_PART = r"\.[A-Za-z][A-Za-z0-9]*"
_STEM_AND_SUFFIX = re.compile(rf"(.+?)((?:{_SUFFIX_PART}){{1,2}})", re.DOTALL)


@dataclass
class PendingFile:
    """A file that is being written.

    Attributes:
        temporary: path to write the content to.
        path: the path that the file will get; after the block of `pending_file`, the path that it has got.
    """

    temporary: Path
    path: Path


def write_atomic(
    path: str | os.PathLike[str], data: bytes | memoryview, *, overwrite: bool = True, rename: bool = True
) -> Path:
    """Write `data` to `path` atomically: readers always find the old file or the new one, also after a crash.

    Arguments and errors are those of `pending_file`.

    Returns:
        The path that was written.
    """
    # The view is always released. If the traceback of a failure kept the view of a BytesIO, the garbage collector of
    # Python 3.12.1 would crash.
    with memoryview(data) as view:
        del data
        with pending_file(path, view.nbytes, overwrite=overwrite, rename=rename) as pending:
            with open(pending.temporary, "wb") as file:
                file.write(view)
    return pending.path


@contextmanager
def replace_file(path: str | os.PathLike[str], length: int | None = None) -> Iterator[Path]:
    """Yield the temporary path of a `pending_file` that replaces the file at `path`."""
    with pending_file(path, length) as pending:
        yield pending.temporary


@contextmanager
def pending_file(
    path: str | os.PathLike[str], length: int | None = None, *, overwrite: bool = True, rename: bool = True
) -> Iterator[PendingFile]:
    """Yield a temporary file beside `path`, which gets its final name when the block ends.

    The bytes are forced to the disk before the file gets its name. If anything fails, or an interrupt comes, the file
    at `path` is untouched and the temporary file is removed. The next call that writes into the same folder removes the
    temporary files of killed processes (but not on Windows).

    With `overwrite`, the file replaces an existing one. The last of several simultaneous writers wins. If `path` is a
    link, its target is replaced. Without `overwrite`, no file is ever replaced, not even one that appears at the last
    moment: a hard link gives the file its name, which fails if the name is taken. On file systems without hard links
    (FAT, some network file systems), an empty file takes the name first; a crash at that moment would leave it behind.

    Args:
        path: path of the file; its folder is created if missing.
        length: number of bytes that will be written, for the message when the disk is full.
        overwrite: replace a file at `path`.
        rename: if a file at `path` may not be replaced, use the first free name of `numbered_names` instead of raising
            an error.

    Raises:
        HyrfError: the folder cannot be created, is not writable or is full; with `overwrite`, `path` exists and is not
            a file; with neither `overwrite` nor `rename`, `path` exists. An OSError in the block is reported as a
            failed write.
    """
    path = Path(path)
    with naming_failed_write(path, length):
        make_folder(Path(os.path.realpath(path)).parent)
        if overwrite and os.path.exists(path) and not os.path.isfile(path):
            if os.path.isdir(path):
                raise HyrfError(f"{path}: this is a folder", fix="name a file in it")
            raise HyrfError(f"{path}: this is a device or a pipe", fix="name a file")
        target = Path(os.path.realpath(path) if overwrite else os.path.join(os.path.realpath(path.parent), path.name))
        with _temporary_file(target.parent) as temporary:
            pending = PendingFile(temporary, path)
            yield pending
            with open(temporary, "rb+") as file:
                os.fsync(file.fileno())
            if overwrite:
                os.replace(temporary, target)
            else:
                pending.path = path.with_name(_move_to_free_name(temporary, target, rename).name)
        _sync_folder(target.parent)


@contextmanager
def naming_failed_write(path: str | os.PathLike[str], length: int | None = None) -> Iterator[None]:
    """Turn an OSError in the block into a HyrfError that says that `path`, of `length` bytes, was not written."""
    try:
        yield
    except OSError as error:
        raise _write_error(path, length, error) from error


@contextmanager
def temporary_folder(parent: Path) -> Iterator[Path]:
    """Yield a new, empty folder in an existing one, and remove it with all that it holds at the end.

    Like temporary files, the folders of killed processes are removed by the next call that writes into `parent` (but
    not on Windows).

    Raises:
        OSError: the folder cannot be created.
    """
    _remove_stale_files(parent)
    folder, lock = _create_locked_folder(parent)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        if lock is not None:
            os.close(lock)


def numbered_names(path: Path) -> Iterator[Path]:
    """Yield a path, then paths beside it with a number from 2 on between stem and suffix.

    A suffix has one or two parts, each of which begins with a letter. One of over half a name is part of the stem.

    Example:
        >>> from itertools import islice
        >>> [str(name) for name in islice(numbered_names(Path("out/scene.points.ply")), 3)]
        ['out/scene.points.ply', 'out/scene-2.points.ply', 'out/scene-3.points.ply']
    """
    yield path
    match = _STEM_AND_SUFFIX.fullmatch(path.name)
    stem, suffix = match.groups() if match else (path.name, "")
    if len(os.fsencode(suffix)) > MAX_NAME_BYTES // 2:
        stem, suffix = path.name, ""
    for number in itertools.count(2):
        end = f"-{number}{suffix}"
        while len(os.fsencode(stem + end)) > MAX_NAME_BYTES:
            stem = stem[:-1]
        yield path.with_name(stem + end)


def describe_rename(asked: str | os.PathLike[str], written: str | os.PathLike[str]) -> str:
    """Return a sentence that explains why a file was written under another name than requested."""
    return f"{asked}: this file was created by something else in the meantime and is kept; the result is in {written}"


def _move_to_free_name(temporary: Path, target: Path, rename: bool) -> Path:
    """Move a finished file to `target`, or with `rename` to the first free name beside it, and return that path.

    The file may keep its temporary name as well.
    """
    for name in numbered_names(target):
        try:
            _move_without_replacing(temporary, name)
            return name
        except FileExistsError:
            if not rename:
                raise HyrfError(
                    f"{target}: another program created this file in the meantime, and it is kept",
                    fix="name another place, or replace it with `overwrite=True`",
                ) from None
    raise AssertionError("numbers never end")


def _move_without_replacing(temporary: Path, target: Path) -> None:
    """Move a file to a free path.

    Raises:
        FileExistsError: `target` exists. The system checks this in the same step in which it gives the name.
    """
    try:
        os.link(temporary, target)
    except FileExistsError:
        raise
    except OSError:  # This file system has no hard links.
        os.close(os.open(target, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666))
        try:
            os.replace(temporary, target)
        except BaseException:
            target.unlink()
            raise


def remove_if_possible(path: Path) -> None:
    """Remove a file if it exists. One that cannot be removed stays, so that results that are written count."""
    with contextlib.suppress(OSError):
        path.unlink(missing_ok=True)


def make_folder(path: Path) -> None:
    """Create a folder and its parents.

    Raises:
        HyrfError: it cannot be created.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise HyrfError(
            f"{path}: the folder cannot be made ({error.strerror or error})",
            fix="choose another place",
        ) from error


def check_writable(folder: Path) -> None:
    """Check that files can be created in a folder, so that writing does not fail after hours of work.

    Raises:
        HyrfError: no file can be created in it.
    """
    try:
        with _temporary_file(folder):
            pass
    except OSError as error:
        raise HyrfError(
            f"{folder}: no file can be made in this folder ({error.strerror or error})",
            fix="choose another place",
        ) from error


@contextmanager
def _temporary_file(folder: Path) -> Iterator[Path]:
    """Yield a new, empty file, and remove it at the end if it still exists; stale files in the folder are removed."""
    _remove_stale_files(folder)
    temporary, lock = _create_locked_file(folder)
    try:
        yield temporary
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        if lock is not None:
            os.close(lock)


def _create_locked_file(folder: Path) -> tuple[Path, int | None]:
    """Create a temporary file and return it with the descriptor of its lock, which shows others that it is in use."""
    while True:
        temporary = folder / _temporary_name()
        # The module tempfile would make the file private (mode 0600).
        descriptor = os.open(temporary, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
        if fcntl is None:  # Windows cannot rename an open file
            os.close(descriptor)
            return temporary, None
        if _lock_temporary(temporary, descriptor):
            return temporary, descriptor


def _create_locked_folder(parent: Path) -> tuple[Path, int | None]:
    """Create a temporary folder and return it with the descriptor of its lock, as `_create_locked_file` does."""
    while True:
        temporary = parent / _temporary_name()
        os.mkdir(temporary)
        if fcntl is None:  # Windows cannot open a folder
            return temporary, None
        with contextlib.suppress(FileNotFoundError):
            descriptor = os.open(temporary, os.O_RDONLY)
            if _lock_temporary(temporary, descriptor):
                return temporary, descriptor


def _temporary_name() -> str:
    return f"{TEMPORARY_PREFIX}{secrets.token_hex(6)}{TEMPORARY_SUFFIX}"


def _lock_temporary(temporary: Path, descriptor: int) -> bool:
    """Lock an open file or folder; return False if another process has removed it as a stale one before."""
    with contextlib.suppress(OSError):  # Some network folders have no locks. Stale files stay there.
        fcntl.flock(descriptor, fcntl.LOCK_EX)
    if temporary.exists():
        return True
    os.close(descriptor)
    return False


def _remove_stale_files(folder: Path) -> None:
    """Remove the temporary files and folders of killed processes, which are those whose lock is free."""
    if fcntl is None:
        return
    try:
        names = os.listdir(folder)
    except OSError:  # The folder is writable but not readable, or does not exist.
        return
    for name in names:
        if name.startswith(TEMPORARY_PREFIX) and name.endswith(TEMPORARY_SUFFIX):
            with contextlib.suppress(OSError):
                is_folder = os.path.isdir(folder / name)
                lock = os.open(folder / name, os.O_RDONLY if is_folder else os.O_RDWR)
                try:
                    fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    if is_folder:
                        shutil.rmtree(folder / name)
                    else:
                        os.unlink(folder / name)
                finally:
                    os.close(lock)


def _sync_folder(folder: Path) -> None:
    """Force a folder's new entry to the disk, so that it survives a power cut.

    Windows and some network folders do not support this. A file that appears there is complete all the same.
    """
    with contextlib.suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def _write_error(path: str | os.PathLike[str], length: int | None, error: OSError) -> HyrfError:
    """Return the error for a file that the system could not write; `length` is its size in bytes, if it is known."""
    size = "some space" if length is None else f"{length:,} bytes"
    if error.errno == errno.ENOSPC:
        return HyrfError(f"{path}: the disk is full and this file was not written", fix=f"free {size} and try again")
    if error.errno == errno.EDQUOT:
        return HyrfError(
            f"{path}: your quota is used up and this file was not written", fix=f"free {size} and try again"
        )
    if error.errno == errno.EFBIG:
        return HyrfError(f"{path}: so large a file is not allowed here (see 'ulimit -f')", fix="choose another place")
    return HyrfError(
        f"{path}: the file cannot be written ({error.strerror or error})",
        fix="choose another place or repair this one",
    )

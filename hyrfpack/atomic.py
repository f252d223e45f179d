"""Files appear whole or not at all."""

from __future__ import annotations

import contextlib
import errno
import itertools
import os
import re
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from hyrfpack.errors import HyrfError

try:
    import fcntl
except ModuleNotFoundError:  # Windows
    fcntl = None  # type: ignore[assignment]

PREFIX, SUFFIX = ".hyrfpack-", ".tmp"  # of temporary files; what is between is random
MAX_NAME_BYTES = 255  # of a file, on common systems
_SUFFIX_PART = r"\.[A-Za-z][A-Za-z0-9]*"
_NAME = re.compile(rf"(.+?)((?:{_SUFFIX_PART}){{1,2}})", re.DOTALL)  # stem and suffix


@dataclass
class PendingFile:
    """A file that is being written.

    Attributes:
        temporary: where to write it.
        path: the name that it will get; after the block of `pending_file`, the name that it has.
    """

    temporary: Path
    path: Path


def write_atomic(
    path: str | os.PathLike[str], data: bytes | memoryview, *, overwrite: bool = True, rename: bool = True
) -> Path:
    """Write `data` to `path` in one step: at any moment, a crash included, readers find the old file or the new one.

    Arguments and errors as `pending_file`. Returns the path that was written.
    """
    # The view is let go of in any case: that of a BytesIO, kept by the traceback of a failure, crashes Python 3.12.1
    # when garbage is collected.
    with memoryview(data) as view:
        del data
        with pending_file(path, view.nbytes, overwrite=overwrite, rename=rename) as pending:
            with open(pending.temporary, "wb") as file:
                file.write(view)
    return pending.path


@contextmanager
def replacing(path: str | os.PathLike[str], length: int | None = None) -> Iterator[Path]:
    """The temporary path of a `pending_file` that replaces what is at `path`."""
    with pending_file(path, length) as pending:
        yield pending.temporary


@contextmanager
def pending_file(
    path: str | os.PathLike[str], length: int | None = None, *, overwrite: bool = True, rename: bool = True
) -> Iterator[PendingFile]:
    """A temporary file beside `path`, which gets its final name when the block ends.

    The bytes are forced to the disk before the file gets its name. When anything fails, an interrupt included, what
    was at `path` is untouched and the temporary file is removed. What a killed process left behind is removed by the
    next one that writes into the same folder (but on Windows).

    With `overwrite`, the file replaces one that is there; of several writers at once the last one wins, and of a link
    the target is replaced. Without `overwrite`, no file is ever replaced, not even one that appears at the last moment:
    the name is given by a hard link, which the system refuses where the name is taken. On file systems without hard
    links (FAT, some network file systems) the name is first claimed by an empty file, which a crash at that moment
    would leave behind.

    Args:
        path: of the file; its folder is created if missing.
        length: bytes that will be written, for the message when the disk is full.
        overwrite: replace a file at `path`.
        rename: where a file at `path` may not be replaced, take the first free one of `numbered_names`; otherwise
            raise.

    Raises:
        HyrfError: the folder cannot be created, is not writable or full; with `overwrite`, what is at `path` is no
            file; with neither `overwrite` nor `rename`, something is at `path`. An OSError in the block counts as one
            of writing.
    """
    path = Path(path)
    try:
        make_folder(Path(os.path.realpath(path)).parent)
        if overwrite and os.path.exists(path) and not os.path.isfile(path):
            kind = "folder; name a file in it" if os.path.isdir(path) else "device or a pipe; name a file"
            raise HyrfError(f"{path}: this is a {kind}")
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
    except OSError as error:
        raise HyrfError(_explain(path, length, error)) from error


def numbered_names(path: Path) -> Iterator[Path]:
    """A path, then those beside it that are numbered from 2, with the whole suffix kept.

    A suffix has one or two parts that begin with a letter.

    Example:
        >>> from itertools import islice
        >>> [str(name) for name in islice(numbered_names(Path("out/scene.points.ply")), 3)]
        ['out/scene.points.ply', 'out/scene-2.points.ply', 'out/scene-3.points.ply']
    """
    yield path
    match = _NAME.fullmatch(path.name)
    stem, suffix = match.groups() if match else (path.name, "")
    for number in itertools.count(2):
        end = f"-{number}{suffix}"
        while len(os.fsencode(stem + end)) > MAX_NAME_BYTES:
            stem = stem[:-1]
        yield path.with_name(stem + end)


def describe_rename(asked: str | os.PathLike[str], written: str | os.PathLike[str]) -> str:
    """Return the sentence that says why a file was written under another name than the one that was asked for."""
    return f"{asked}: this file was created by something else in the meantime and is kept; the result is in {written}"


def _move_to_free_name(temporary: Path, target: Path, rename: bool) -> Path:
    """Give a finished file its name, or the first free one beside it; returns that. The temporary name may stay."""
    for name in numbered_names(target):
        try:
            _move_without_replacing(temporary, name)
            return name
        except FileExistsError:
            if not rename:
                raise HyrfError(
                    f"{target}: another program created this file in the meantime, and it is kept; name another place, "
                    "or replace it with `overwrite=True`"
                ) from None
    raise AssertionError("numbers never end")


def _move_without_replacing(temporary: Path, target: Path) -> None:
    """Raises FileExistsError where something is at `target`, in the same step as the name would be given."""
    try:
        os.link(temporary, target)
    except FileExistsError:
        raise
    except OSError:  # no hard links here
        os.close(os.open(target, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666))
        try:
            os.replace(temporary, target)
        except BaseException:
            target.unlink()
            raise


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

"""Unpack .zip archives of datasets, each once, into a folder of the user's cache that is named by a digest.

Archives are not trusted: an entry outside the folder, a link, or an implausible total size is an error.
"""

from __future__ import annotations

import errno
import hashlib
import os
import re
import shutil
import stat
import tempfile
import time
import zipfile
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath

from hyrfpack.cache_folder import open_cache_folder
from hyrfpack.errors import HyrfDataError, HyrfError, short_reason
from hyrfpack.outputs import ARCHIVE_SUFFIXES

_MAX_FILES = 200_000
# The unpacked size may be at most the archive's size times the ratio, plus the slack. Photos hardly shrink in an
# archive and text shrinks to a tenth, so no dataset has a larger ratio.
_MAX_UNPACKED_RATIO = 100
_UNPACKED_SLACK_BYTES = 1 << 26
_COPY_CHUNK_BYTES = 1 << 20
_PARTIAL_FOLDER_PREFIX = ".partial-"
_MAX_PARTIAL_FOLDER_AGE_SECONDS = 24 * 3600
_archive_by_folder: dict[Path, Path] = {}  # archives whose unpacked files this process has used
_ENCRYPTED_FLAG = 0x1
_UTF8_NAME_FLAG = 0x800
_DISK_FULL_ERRORS = (errno.ENOSPC, errno.EDQUOT)
_POLYCAM_CAMERA = re.compile(r"(.*/)?keyframes/(corrected_)?cameras/")  # start of the path of one of Polycam's cameras


def is_archive(path: Path) -> bool:
    """Return whether a path is a .zip file (or a .r3d file of Record3D).

    The name decides, because many other file formats are ZIP archives, too.
    """
    return path.suffix.lower() in ARCHIVE_SUFFIXES and os.path.isfile(path)


def unpack(archive: Path) -> Path:
    """Unpack an archive into the cache folder, unless it is already there, and return the folder of its files.

    If all files of the archive lie in one common folder, that folder is returned, except Polycam's `keyframes/`, whose
    parent is returned. The unpacked files are kept. Another archive of the same name, or a later version of this one,
    is unpacked into another folder.

    Raises:
        HyrfDataError: the archive is damaged, encrypted or hostile, or the disk has no room for its files.
        HyrfError: there is no cache folder that can be written.
    """
    try:
        with zipfile.ZipFile(archive) as content:
            entries = _checked_entries(archive, content)
            folder = open_cache_folder("archives") / f"{archive.stem[:60]}-{_archive_digest(archive)}"
            if not _is_complete(folder, entries):
                _write_entries(archive, content, entries, folder)
            _archive_by_folder[folder] = archive
            return folder / _common_folder(entries)
    except HyrfError:
        raise
    except OSError as error:
        raise HyrfDataError(
            f"{archive}: its files cannot be unpacked ({error.strerror or error})",
            fix=f"{'make room, or ' * (error.errno in _DISK_FULL_ERRORS)}unpack it yourself and name the folder",
        ) from error
    except (NotImplementedError, RuntimeError) as error:
        raise HyrfDataError(
            f"{archive}: the archive uses a feature of ZIP that is not supported ({str(error)[:120]})",
            fix="unpack it yourself and name the folder",
        ) from error
    except Exception as error:  # zipfile and its decompressors raise exceptions of many types
        raise HyrfDataError(
            f"{archive}: the archive is damaged ({short_reason(error)})",
            fix="copy the archive again, or create it again",
        ) from error


def display_path(path: Path) -> Path:
    """Return the path of a file as the user knows it: the path of an unpacked file starts with its archive's.

    Example:
        >>> display_path(Path("photos/bonsai/images/0000.png")).as_posix()
        'photos/bonsai/images/0000.png'
    """
    for folder, archive in _archive_by_folder.items():
        if path.is_relative_to(folder):
            return archive / path.relative_to(folder)
    return path


@contextmanager
def archive_paths_in_errors() -> Iterator[None]:
    """Replace folders of unpacked archives by the archives' paths in messages of errors that the block raises."""
    try:
        yield
    except HyrfError as error:
        renamed = error
        for folder, archive in _archive_by_folder.items():
            problem, fix = (text.replace(str(folder), str(archive)) for text in (renamed.problem, renamed.fix))
            renamed = renamed.with_text(problem, fix)
        if str(renamed) == str(error):
            raise
        raise renamed from error


def _common_folder(paths: Collection[str]) -> Path:
    """Return the deepest folder that contains all of these relative paths, or the parent of Polycam's keyframes/."""
    parts = os.path.commonprefix([path.split("/")[:-1] for path in paths])
    # Polycam's layout is detected by the folder `keyframes`, which may be all that the archive holds.
    if "keyframes" in parts and any(_POLYCAM_CAMERA.match(path) for path in paths):
        parts = parts[: parts.index("keyframes")]
    return Path(*parts)


def _checked_entries(archive: Path, content: zipfile.ZipFile) -> dict[str, zipfile.ZipInfo]:
    """Map the relative path of each file to its entry, after a check of all paths, flags and the total size."""
    entries: dict[str, zipfile.ZipInfo] = {}
    for info in content.infolist():
        name = _entry_path(info)
        parts = [part for part in name.split("/") if part not in ("", ".")]
        if name.endswith("/") or not parts or parts[0] == "__MACOSX":
            continue
        if name.startswith("/") or ".." in parts or ":" in parts[0] or "\0" in name:
            raise HyrfDataError(
                f"{archive}: the archive holds a file '{name[:80]}' that would be written outside its folder, so "
                "nothing is unpacked",
                fix="create the archive again",
            )
        if stat.S_ISLNK(info.external_attr >> 16):
            raise HyrfDataError(
                f"{archive}: the archive holds a link, '{name[:80]}'",
                fix="create the archive again with the files themselves",
            )
        if info.flag_bits & _ENCRYPTED_FLAG:
            raise HyrfDataError(f"{archive}: the archive is encrypted", fix="unpack it yourself and name the folder")
        path = "/".join(parts)
        if path in entries:
            raise HyrfDataError(f"{archive}: the archive holds '{path[:80]}' twice", fix="create the archive again")
        entries[path] = info
    for folder in {parent.as_posix() for path in entries for parent in PurePosixPath(path).parents}:
        if folder in entries:
            raise HyrfDataError(
                f"{archive}: its files cannot be unpacked, because '{folder[:80]}' is both a file and a folder in it",
                fix="create the archive again",
            )
    if not entries:
        raise HyrfDataError(f"{archive}: the archive holds no files", fix="name the archive of a set of photos")
    total = sum(info.file_size for info in entries.values())
    if len(entries) > _MAX_FILES or total > _MAX_UNPACKED_RATIO * os.path.getsize(archive) + _UNPACKED_SLACK_BYTES:
        raise HyrfDataError(
            f"{archive}: the archive would unpack to {len(entries):,} files of {total / 1e9:,.1f} GB in total, which "
            "is unlikely for a set of photos",
            fix="unpack it yourself if you trust it",
        )
    return entries


def _entry_path(info: zipfile.ZipInfo) -> str:
    """Return an entry's path with forward slashes; programs on Windows may write backslashes."""
    name = info.filename
    if not info.flag_bits & _UTF8_NAME_FLAG:  # macOS writes UTF-8 without the flag, and zipfile decodes it as cp437
        with suppress(UnicodeError):
            name = name.encode("cp437").decode("utf-8")
    return name.replace("\\", "/")


def _is_complete(folder: Path, entries: dict[str, zipfile.ZipInfo]) -> bool:
    """Return whether a folder holds all files in full; a program that cleans up caches may have deleted some."""
    try:
        return all(os.path.getsize(folder / path) == info.file_size for path, info in entries.items())
    except OSError:
        return False


def _write_entries(archive: Path, content: zipfile.ZipFile, entries: dict[str, zipfile.ZipInfo], folder: Path) -> None:
    """Write all files into a temporary folder, and rename it to `folder` when it is complete."""
    _remove_stale_partial_folders(folder.parent)
    total, free = sum(info.file_size for info in entries.values()), shutil.disk_usage(folder.parent).free
    if total > free:
        raise HyrfDataError(
            f"{archive}: its {total / 1e9:.1f} GB of files do not fit on the disk of {folder.parent}, which has "
            f"{free / 1e9:.1f} GB left",
            fix="make room, or unpack it elsewhere and name the folder",
        )
    partial = Path(tempfile.mkdtemp(prefix=_PARTIAL_FOLDER_PREFIX, dir=folder.parent))
    try:
        for path, info in entries.items():
            target = partial / path
            target.parent.mkdir(parents=True, exist_ok=True)
            with content.open(info) as source, target.open("xb") as file:
                shutil.copyfileobj(source, file, _COPY_CHUNK_BYTES)
        if not _is_complete(folder, entries):  # it is complete if another process was faster
            shutil.rmtree(folder, ignore_errors=True)
            try:
                os.replace(partial, folder)
            except OSError:
                if not _is_complete(folder, entries):
                    raise
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _remove_stale_partial_folders(cache: Path) -> None:
    """Remove temporary folders whose process was killed while it unpacked."""
    for partial in cache.glob(f"{_PARTIAL_FOLDER_PREFIX}*"):
        with suppress(OSError):  # another process may rename or remove the folder meanwhile
            if time.time() - partial.stat().st_mtime > _MAX_PARTIAL_FOLDER_AGE_SECONDS:
                shutil.rmtree(partial, ignore_errors=True)


def _archive_digest(archive: Path) -> str:
    """Hash an archive's path, size and modification time."""
    stat_result = os.stat(archive)
    text = f"{os.path.realpath(archive)}\0{stat_result.st_size}\0{stat_result.st_mtime_ns}"
    return hashlib.sha256(os.fsencode(text)).hexdigest()[:12]

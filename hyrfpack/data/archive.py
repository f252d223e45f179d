"""Sets that come as one .zip: unpacked once, into a folder among the system's caches that the archive's identity names.

An archive is not trusted: nothing is written outside that folder, no more than its size makes likely, and no link.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import stat
import sys
import tempfile
import time
import zipfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from hyrfpack.errors import HyrfDataError, HyrfError, short_reason
from hyrfpack.outputs import ARCHIVE_SUFFIXES

_MOST_FILES = 200_000
_MOST_RATIO, _SLACK_BYTES = 100, 1 << 26  # photos hardly shrink in an archive; text does, to a tenth
_CHUNK = 1 << 20
_PARTIAL = ".partial-"  # of folders that are being unpacked into
_STALE_SECONDS = 24 * 3600
_archive_of: dict[Path, Path] = {}  # by the folder that it was unpacked into, in this process
_ENCRYPTED, _UTF8 = 0x1, 0x800  # flags of entries


def is_archive(path: Path) -> bool:
    """Whether a path is a .zip file (or a .r3d, Record3D's), by its name: many a file of another kind is one inside."""
    return path.suffix.lower() in ARCHIVE_SUFFIXES and os.path.isfile(path)


def unpacked(archive: Path) -> Path:
    """The folder with an archive's files, which are written there unless they are there already; where all of them lie
    in one folder, as in an archive of a folder, that one.

    The folder is kept and belongs to this very archive: another of its name, or a later state of it, gets its own.

    Raises:
        HyrfDataError: the archive is damaged, encrypted, or hostile, or there is no room for its files.
    """
    try:
        with zipfile.ZipFile(archive) as content:
            entries = _entries(archive, content)
            folder = _cache() / f"{archive.stem[:60]}-{_identity(archive)}"
            if not _is_whole(folder, entries):
                _unpack(archive, content, entries, folder)
            _archive_of[folder] = archive
            return folder / _common_folder(entries)
    except HyrfDataError:
        raise
    except OSError as error:
        raise HyrfDataError(
            f"{archive}: its files cannot be unpacked ({error.strerror or error}); make room, or unpack it yourself "
            "and give the folder"
        ) from error
    except (NotImplementedError, RuntimeError) as error:
        raise HyrfDataError(
            f"{archive}: the archive is packed in a way that cannot be read here ({str(error)[:120]}); unpack it "
            "yourself and give the folder"
        ) from error
    except Exception as error:  # zipfile and its decompressors raise whatever they meet
        raise HyrfDataError(
            f"{archive}: the archive is damaged ({short_reason(error)}); copy or make it again"
        ) from error


def given_path(path: Path) -> Path:
    """The path of a file as the user knows it: one that was unpacked is named by its place in the archive.

    Example:
        >>> given_path(Path("photos/bonsai/images/0000.png")).as_posix()
        'photos/bonsai/images/0000.png'
    """
    for folder, archive in _archive_of.items():
        if path.is_relative_to(folder):
            return archive / path.relative_to(folder)
    return path


@contextmanager
def naming_archives() -> Iterator[None]:
    """Make errors that are raised inside name files by their places in archives, as `given_path` does."""
    try:
        yield
    except HyrfError as error:
        sentence = str(error)
        for folder, archive in _archive_of.items():
            sentence = sentence.replace(str(folder), str(archive))
        if sentence == str(error):
            raise
        raise type(error)(sentence) from error


def _common_folder(paths: Iterable[str]) -> Path:
    """The folder that all of these relative paths lie in."""
    return Path(*os.path.commonprefix([path.split("/")[:-1] for path in paths]))


def _entries(archive: Path, content: zipfile.ZipFile) -> dict[str, zipfile.ZipInfo]:
    """Relative path -> entry of each file in it, none of which leads out, and which together are of a likely size."""
    entries: dict[str, zipfile.ZipInfo] = {}
    for info in content.infolist():
        name = _name(info)
        parts = [part for part in name.split("/") if part not in ("", ".")]
        if name.endswith("/") or not parts or parts[0] == "__MACOSX":
            continue
        if name.startswith("/") or ".." in parts or ":" in parts[0] or "\0" in name:
            raise HyrfDataError(
                f"{archive}: holds a file '{name[:80]}' that would be written outside its folder, so nothing of it is "
                "unpacked; make it again"
            )
        if stat.S_ISLNK(info.external_attr >> 16):
            raise HyrfDataError(f"{archive}: holds a link, '{name[:80]}'; make it again of the files themselves")
        if info.flag_bits & _ENCRYPTED:
            raise HyrfDataError(f"{archive}: the archive is encrypted; unpack it yourself and give the folder")
        path = "/".join(parts)
        if path in entries:
            raise HyrfDataError(f"{archive}: holds '{path[:80]}' twice; make it again")
        entries[path] = info
    if not entries:
        raise HyrfDataError(f"{archive}: the archive holds no file; give one of a set of photos")
    total = sum(info.file_size for info in entries.values())
    if len(entries) > _MOST_FILES or total > _MOST_RATIO * os.path.getsize(archive) + _SLACK_BYTES:
        raise HyrfDataError(
            f"{archive}: would unpack to {len(entries):,} files of {total / 1e9:,.1f} GB together, which is no likely "
            "set of photos; unpack it yourself if you trust it"
        )
    return entries


def _name(info: zipfile.ZipInfo) -> str:
    """An entry's path, with slashes where a program on Windows wrote others."""
    name = info.filename
    if not info.flag_bits & _UTF8:  # macOS writes UTF-8 without saying so, and zipfile takes it for cp437
        with suppress(UnicodeError):
            name = name.encode("cp437").decode("utf-8")
    return name.replace("\\", "/")


def _is_whole(folder: Path, entries: dict[str, zipfile.ZipInfo]) -> bool:
    """Whether all files are there: what cleans caches up may have taken some."""
    try:
        return all(os.path.getsize(folder / path) == info.file_size for path, info in entries.items())
    except OSError:
        return False


def _unpack(archive: Path, content: zipfile.ZipFile, entries: dict[str, zipfile.ZipInfo], folder: Path) -> None:
    """Write all files into a folder of another name, which takes the right one when it is whole."""
    _remove_litter(folder.parent)
    total, free = sum(info.file_size for info in entries.values()), shutil.disk_usage(folder.parent).free
    if total > free:
        raise HyrfDataError(
            f"{archive}: its {total / 1e9:.1f} GB of files do not fit on the disk of {folder.parent}, which has "
            f"{free / 1e9:.1f} GB left; make room, or unpack it elsewhere and give the folder"
        )
    partial = Path(tempfile.mkdtemp(prefix=_PARTIAL, dir=folder.parent))
    try:
        for path, info in entries.items():
            target = partial / path
            target.parent.mkdir(parents=True, exist_ok=True)
            with content.open(info) as source, target.open("xb") as file:
                shutil.copyfileobj(source, file, _CHUNK)
        if not _is_whole(folder, entries):  # or another process was faster
            shutil.rmtree(folder, ignore_errors=True)
            try:
                os.replace(partial, folder)
            except OSError:
                if not _is_whole(folder, entries):
                    raise
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _remove_litter(cache: Path) -> None:
    """What was being unpacked when its process was killed."""
    for partial in cache.glob(f"{_PARTIAL}*"):
        with suppress(OSError):  # of another process, which is done with it
            if time.time() - partial.stat().st_mtime > _STALE_SECONDS:
                shutil.rmtree(partial, ignore_errors=True)


def _identity(archive: Path) -> str:
    about = os.stat(archive)
    text = f"{os.path.realpath(archive)}\0{about.st_size}\0{about.st_mtime_ns}"
    return hashlib.sha256(os.fsencode(text)).hexdigest()[:12]


def _cache() -> Path:
    """Our folder among the user's caches; one among temporary files where there is no home to write to."""
    home = os.path.expanduser("~")
    usual = {"darwin": f"{home}/Library/Caches", "win32": os.environ.get("LOCALAPPDATA", home)}
    kept = os.environ.get("XDG_CACHE_HOME") or usual.get(sys.platform, f"{home}/.cache")
    user = os.getuid() if hasattr(os, "getuid") else "user"
    for place in (Path(kept, "hyrfpack", "archives"), Path(tempfile.gettempdir(), f"hyrfpack-{user}")):
        try:
            place.mkdir(mode=0o700, parents=True, exist_ok=True)
            ours = not hasattr(os, "getuid") or place.stat().st_uid == os.getuid()  # and nobody else's among them
            if ours and os.access(place, os.W_OK | os.X_OK):
                return place
        except OSError:
            continue
    raise HyrfDataError(f"{kept}: no file can be made in this folder; set XDG_CACHE_HOME to one where they can")

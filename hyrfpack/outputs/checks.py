"""Check output paths, to protect the user's files.

1. A file that is read is never replaced, and no file is written into a folder that photos or poses are read from.
2. Without `overwrite`, no existing file is replaced, and no file is written into a folder of other photos or poses.

`rules` decides; this module collects what the rules ask for. The checks run before any work, so that a command does not
fail after minutes. Files that appear during the work are kept as well, because `atomic` checks again in the step that
gives a finished file its name. `lock` keeps a second call of hyrfpack out of a folder that the first one writes into.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from hyrfpack.atomic import MAX_NAME_BYTES, check_writable
from hyrfpack.errors import HyrfError
from hyrfpack.outputs.names import (
    ARCHIVE_SUFFIXES,
    COLMAP_MODEL_FOLDERS,
    COLMAP_TABLE_NAMES,
    PICTURE_SUFFIXES,
    POSE_FILE_NAMES,
)
from hyrfpack.outputs.rules import FileFacts, Refusal, refuse_file

if TYPE_CHECKING:
    from hyrfpack.scene import Scene

MAX_PATH_BYTES = 4095  # This is the limit of common systems.

StrPath = str | os.PathLike[str]


class Outputs:
    """Checks the files that a command will write against those that it reads and those that exist.

    Each method raises HyrfError for a file that may not or cannot be written, and writes nothing itself.

    Example:
        >>> outputs = Outputs("run/model.hyrf", scene=scene)
        >>> outputs.file("bonsai.hyrf", ".hyrf")
        >>> outputs.folder("compare", ["0001.png", "0009.png"])
    """

    def __init__(
        self,
        *files: StrPath | None,
        folders: Iterable[StrPath | None] = (),
        scene: Scene | None = None,
        overwrite: bool = False,
    ) -> None:
        """Collect the inputs that no output may replace.

        Args:
            files: files that are read; None and files that do not exist are ignored.
            folders: folders whose files are all read; None is ignored.
            scene: photos and poses that are read.
            overwrite: existing files may be replaced, except those that are read.
        """
        self.overwrite = overwrite
        self._files = _file_ids(filter(None, files))
        self._folders: set[tuple[int, int]] = set()
        for folder in (item for item in folders if item is not None and os.path.isdir(item)):
            self._files |= _file_ids(Path(folder, name) for name in _entry_names(folder))
            self._folders |= _file_ids([folder])
        if scene is not None:
            self._files |= _file_ids(scene.files)
            loose = (file for file in scene.files if not file.lower().endswith(ARCHIVE_SUFFIXES))
            self._folders |= _file_ids(_folders_between(scene.path, loose))

    def file(self, path: StrPath, *endings: str) -> None:
        """Check one file that will be written.

        Args:
            path: path of the file.
            endings: allowed suffixes of its name; if none are given, any name is allowed.
        """
        path = Path(path)
        self._raise_if_refused(path, self.overwrite, endings)
        _check_name_lengths([path])
        _check_folder(_resolved_folder(path))

    def folder(self, folder: StrPath, names: Iterable[str]) -> None:
        """Check files that will be written into a folder or its subfolders.

        Args:
            folder: the folder, which need not exist.
            names: paths of the files, relative to the folder.
        """
        if os.fspath(folder) == "":  # Python would write into the current folder
            raise HyrfError("'' is not a path", fix="name a folder")
        if os.path.lexists(folder) and not os.path.isdir(folder):
            raise HyrfError(f"{folder}: this is a file", fix="name a folder")
        paths = [Path(folder, name) for name in names]
        folders = list(dict.fromkeys((Path(folder), *(path.parent for path in paths))))
        for place in folders:
            if self._is_read(place):
                raise HyrfError(f"{place}: {Refusal.READ_FOLDER.problem}", fix=Refusal.READ_FOLDER.fix)
        existing = [path for path in paths if os.path.lexists(path)]
        for path in existing:
            self._raise_if_refused(path, overwrite=True)
        if not self.overwrite:
            if existing:
                more = f" and {len(existing) - 1} more" if len(existing) > 1 else ""
                raise HyrfError(
                    f"{folder}: {existing[0].relative_to(folder)}{more} of the files to be written "
                    f"{'are' if more else 'is'} there",
                    fix="name another folder, or replace them with `overwrite=True`",
                )
            for place in folders:
                if _has_poses(place) or _has_pictures(place):
                    raise HyrfError(f"{place}: {Refusal.PHOTO_SET.problem}", fix=Refusal.PHOTO_SET.fix)
        for place in folders:
            _check_folder(place)
        _check_name_lengths(paths)

    def _raise_if_refused(self, path: Path, overwrite: bool, endings: tuple[str, ...] = ()) -> None:
        """Raise an error for a file that may not be written."""
        folder, exists = _resolved_folder(path), os.path.exists(path)
        facts = FileFacts(
            is_folder=os.path.isdir(path),
            is_device=exists and not os.path.isfile(path) and not os.path.isdir(path),
            is_input=bool(_file_ids([path]) & self._files),
            folder_is_read=self._is_read(folder),
            has_ending=not endings or str(path).lower().endswith(endings),
            exists=os.path.lexists(path),
            in_photo_set=not overwrite and _belongs_to_photo_set(folder),
        )
        refusal = refuse_file(facts, overwrite)
        if refusal is Refusal.ENDING:
            raise HyrfError(f"{path}: the file extension must be {' or '.join(endings)}", fix="change the extension")
        if refusal is not None:
            raise HyrfError(f"{folder if refusal is Refusal.READ_FOLDER else path}: {refusal.problem}", fix=refusal.fix)

    def _is_read(self, folder: StrPath) -> bool:
        """Return whether photos or poses of a folder are read."""
        return bool(_file_ids([folder]) & self._folders)


def _folders_between(top: StrPath, files: Iterable[StrPath]) -> set[Path]:
    """Return the folder `top`, the folders of the files, and all folders between `top` and those below it."""
    root = _resolved(top)
    found = {root}
    for folder in {_resolved(file).parent for file in files}:
        inside = [above for above in folder.parents if above.is_relative_to(root)]
        found |= {folder, *inside}
    return found


def _file_ids(paths: Iterable[StrPath]) -> set[tuple[int, int]]:
    """Return the device and inode number of each existing path, which all names and links of a file share."""
    found = set()
    for path in paths:
        try:
            status = os.stat(path)
        except OSError:
            continue
        found.add((status.st_dev, status.st_ino))
    return found


def _resolved_folder(path: StrPath) -> Path:
    """Return the folder of a file with all links followed, because a write replaces the target of a link."""
    return _resolved(path).parent


def _resolved(path: StrPath) -> Path:
    """Return a path with all links followed."""
    try:
        return Path(os.path.realpath(path))
    except OSError as error:  # The working folder was removed.
        raise HyrfError(
            f"{path}: the path cannot be resolved ({error.strerror})",
            fix="give an absolute path",
        ) from error


def _check_name_lengths(paths: Iterable[StrPath]) -> None:
    """Raise an error for names and paths that are too long for common systems."""
    for path in map(os.path.abspath, paths):
        for part in Path(path).parts:
            if len(os.fsencode(part)) > MAX_NAME_BYTES:
                raise HyrfError(f"{part[:40]}...: the name is longer than {MAX_NAME_BYTES} bytes", fix="shorten it")
        if len(os.fsencode(path)) > MAX_PATH_BYTES:
            raise HyrfError(f"{path[:40]}...: the path is longer than {MAX_PATH_BYTES} bytes", fix="shorten it")


def _check_folder(folder: Path) -> None:
    """Raise an error for a folder in which no file can be created, or that cannot be created itself."""
    resolved = _resolved(folder)
    existing = next(path for path in (resolved, *resolved.parents) if os.path.lexists(path))
    if not existing.is_dir():
        raise HyrfError(f"{folder}: {existing} is a file, not a folder", fix="name another place")
    check_writable(existing)


def _belongs_to_photo_set(folder: Path) -> bool:
    """Return whether a folder belongs to a set of posed photos.

    It does if it holds photos and poses, if it is a folder of photos in such a set, or if it is a COLMAP model.
    Pictures alone do not count, because users write files into many folders that hold pictures.
    """
    names = _entry_names(folder)
    if not names.isdisjoint(COLMAP_TABLE_NAMES):
        return True
    photos = _has_pictures(folder)
    if _has_poses(folder) and (photos or any(_has_pictures(folder / name) for name in names)):
        return True
    results = any(name.endswith(".hyrf") for name in names)
    return photos and not results and _has_poses(folder.parent)


def _has_poses(folder: Path) -> bool:
    """Return whether a folder holds poses under a name that only poses have, unlike many .csv and .xml files."""
    if not _entry_names(folder).isdisjoint((*COLMAP_TABLE_NAMES, *POSE_FILE_NAMES)):
        return True
    models = [folder / name for name in COLMAP_MODEL_FOLDERS]
    models += [model / name for model in models for name in _entry_names(model)]
    return any(not _entry_names(model).isdisjoint(COLMAP_TABLE_NAMES) for model in models)


def _has_pictures(folder: Path) -> bool:
    """Return whether a folder itself holds pictures."""
    return any(name.lower().endswith(PICTURE_SUFFIXES) for name in _entry_names(folder))


def _entry_names(folder: StrPath) -> set[str]:
    """Return the names of all entries of a folder; none if it is not a folder or cannot be read."""
    try:
        return set(os.listdir(folder))
    except OSError:
        return set()

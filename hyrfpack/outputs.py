"""What may be written where: the one rule that keeps what a person has.

1. What is read is never replaced, and nothing is put into a folder that photos or poses are read from.
2. Nothing is put among other photos or poses, and no file that is there is replaced, unless `overwrite` says so.

It is asked before any work, so that nothing is found out after minutes that was known at once. What appears during
the work is kept, too: `atomic` checks again in the step that gives a finished file its name, and `lock` keeps a second
call of hyrfpack out of a folder that a first one writes into.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from hyrfpack.atomic import MAX_NAME_BYTES, check_writable
from hyrfpack.errors import HyrfError

if TYPE_CHECKING:
    from hyrfpack.scene import Scene

# Pictures that are taken for photos; where a name has no ending, the first of these that is there is meant.
READABLE = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp", ".avif", ".jp2", ".heic", ".heif", ".hif")
# Raw photos of cameras: they are never read, so that they are counted and named to the user where they lie.
RAW_PHOTOS = (
    *(".3fr", ".arw", ".cr2", ".cr3", ".crw", ".dcr", ".dng", ".erf", ".fff", ".gpr", ".iiq", ".kdc", ".mos", ".mrw"),
    *(".nef", ".nrw", ".orf", ".pef", ".raf", ".rw2", ".rwl", ".sr2", ".srf", ".srw", ".x3f"),
)
PICTURES = (*READABLE, *RAW_PHOTOS)  # all that people keep photos as
VIDEOS = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".3gp", ".mts", ".m2ts", ".mpg", ".mpeg", ".wmv")
ARCHIVES = (".zip", ".r3d")  # sets that are one file
TABLES = tuple(f"{table}{kind}" for table in ("cameras", "images", "points3D") for kind in (".bin", ".txt"))
POSES = (
    *("transforms.json", "transforms_train.json", "transforms_val.json", "transforms_test.json"),
    *("poses_bounds.npy", "bundle.out", "cameras.xml", "metadata", "keyframes"),
)
MODELS = ("sparse", "colmap/sparse")  # folders of COLMAP models
LONGEST_PATH = 4095  # bytes, of common systems

StrPath = str | os.PathLike[str]


class Outputs:
    """Checks what a command is going to write against what it reads and what is there.

    Every method raises HyrfError at what may not or cannot be written, and writes nothing itself.

    Example:
        >>> outputs = Outputs("run/model.hyrf", scene=scene)
        >>> outputs.file("bonsai.hyrf", ".hyrf")
        >>> outputs.folder("compare", ["0001.png", "0009.png"])
    """

    def __init__(
        self,
        *files: StrPath | None,
        folder: StrPath | None = None,
        scene: Scene | None = None,
        overwrite: bool = False,
    ) -> None:
        """
        Args:
            files: that are read; None and what is not there count for nothing.
            folder: whose files are read.
            scene: photos and poses that are read.
            overwrite: files that are there may be replaced, but for those that are read.
        """
        self.overwrite = overwrite
        self._files = _identities(filter(None, files))
        self._folders: set[tuple[int, int]] = set()
        if folder is not None and os.path.isdir(folder):
            self._files |= _identities(Path(folder, name) for name in _names(folder))
            self._folders |= _identities([folder])
        if scene is not None:
            self._files |= _identities(scene.files)
            beside = (file for file in scene.files if not file.lower().endswith(ARCHIVES))
            self._folders |= _identities(_folders_between(scene.path, beside))

    def file(self, path: StrPath, *endings: str) -> None:
        """Check one file to be written, whose name must have one of the endings, if any are given."""
        path = Path(path)
        if os.path.isdir(path):
            raise HyrfError(f"{path}: this is a folder; name a file in it")
        self._check(path)
        if endings and not str(path).lower().endswith(endings):
            raise HyrfError(f"{path}: what is written here ends in {' or '.join(endings)}; name the file so")
        if os.path.lexists(path):
            if not self.overwrite:
                raise HyrfError(
                    f"{path}: there is a file of this name; name another, or replace it with `overwrite=True`"
                )
        elif not self.overwrite and _of_a_set(_folder_of(path)):
            raise HyrfError(
                f"{path}: photos or poses lie in this folder; name another, or write there with `overwrite=True`"
            )
        _check_names([path])
        _check_place(_folder_of(path))

    def folder(self, folder: StrPath, names: Iterable[str]) -> None:
        """Check files to be written into a folder and folders in it, by their names relative to it."""
        if os.path.lexists(folder) and not os.path.isdir(folder):
            raise HyrfError(f"{folder}: this is a file; name a folder")
        paths = [Path(folder, name) for name in names]
        places = list(dict.fromkeys((Path(folder), *(path.parent for path in paths))))
        for place in places:
            self._refuse_folder_read(place)
        there = [path for path in paths if os.path.lexists(path)]
        for path in there:
            self._check(path)
        if not self.overwrite:
            if there:
                more = f" and {len(there) - 1} more" if len(there) > 1 else ""
                raise HyrfError(
                    f"{folder}: {there[0].relative_to(folder)}{more} of the files to be written "
                    f"{'are' if more else 'is'} there; name another folder, or replace them with `overwrite=True`"
                )
            for place in places:
                if _has_poses(place) or _has_pictures(place):
                    raise HyrfError(
                        f"{place}: photos or poses lie in this folder; name another, or write there with "
                        "`overwrite=True`"
                    )
        for place in places:
            _check_place(place)
        _check_names(paths)

    def _check(self, path: StrPath) -> None:
        """Refuse what is read, under whatever name, and what is no file."""
        if _identities([path]) & self._files:
            raise HyrfError(f"{path}: the output is an input itself; name another file")
        if os.path.exists(path) and not os.path.isfile(path):
            kind = "folder" if os.path.isdir(path) else "device or a pipe"
            raise HyrfError(f"{path}: this is a {kind}; name a file")
        self._refuse_folder_read(_folder_of(path))

    def _refuse_folder_read(self, folder: StrPath) -> None:
        if _identities([folder]) & self._folders:
            raise HyrfError(f"{folder}: the same command reads what lies in this folder; name another to write into")


def _folders_between(top: StrPath, files: Iterable[StrPath]) -> set[Path]:
    """A folder, those that files lie in, and where these lie in it, all on the way."""
    root = _real(top)
    found = {root}
    for folder in {_real(file).parent for file in files}:
        inside = [above for above in folder.parents if above.is_relative_to(root)]
        found |= {folder, *inside}
    return found


def _identities(paths: Iterable[StrPath]) -> set[tuple[int, int]]:
    """Device and number of each path that is there: the same for all its names and links."""
    found = set()
    for path in paths:
        try:
            status = os.stat(path)
        except OSError:
            continue
        found.add((status.st_dev, status.st_ino))
    return found


def _folder_of(path: StrPath) -> Path:
    """The folder that a file lies in, links followed, for that is where it will be replaced."""
    return _real(path).parent


def _real(path: StrPath) -> Path:
    try:
        return Path(os.path.realpath(path))
    except OSError as error:  # the working folder was removed
        raise HyrfError(f"{path}: the place cannot be found ({error.strerror}); name a whole path") from error


def _check_names(paths: Iterable[StrPath]) -> None:
    """Refuse names that cannot be."""
    for path in map(os.path.abspath, paths):
        for part in Path(path).parts:
            if len(os.fsencode(part)) > MAX_NAME_BYTES:
                raise HyrfError(f"{part[:40]}...: the name is longer than {MAX_NAME_BYTES} bytes; shorten it")
        if len(os.fsencode(path)) > LONGEST_PATH:
            raise HyrfError(f"{path[:40]}...: the path is longer than {LONGEST_PATH} bytes; shorten it")


def _check_place(folder: Path) -> None:
    """Refuse a folder that no file can be made in, or that cannot be made itself."""
    place = _real(folder)
    above = next(path for path in (place, *place.parents) if os.path.lexists(path))
    if not above.is_dir():
        raise HyrfError(f"{folder}: {above} is a file, not a folder; name another place")
    check_writable(above)


def _of_a_set(folder: Path) -> bool:
    """Whether photos or poses are kept here: a folder with both, one of its folders of photos, or a COLMAP model.

    Pictures alone say nothing, for there are some in many a folder that people write other files to.
    """
    names = _names(folder)
    if not names.isdisjoint(TABLES):
        return True
    photos = _has_pictures(folder)
    if _has_poses(folder) and (photos or any(_has_pictures(folder / name) for name in names)):
        return True
    results = any(name.endswith(".hyrf") for name in names)
    return photos and not results and _has_poses(folder.parent)


def _has_poses(folder: Path) -> bool:
    if not _names(folder).isdisjoint((*TABLES, *POSES)):
        return True
    places = [folder / place for place in MODELS]
    places += [place / name for place in places for name in _names(place)]
    return any(not _names(place).isdisjoint(TABLES) for place in places)


def _has_pictures(folder: Path) -> bool:
    return any(name.lower().endswith(PICTURES) for name in _names(folder))


def _names(folder: StrPath) -> set[str]:
    """Names of what lies in a folder; none where it is none or cannot be read."""
    try:
        return set(os.listdir(folder))
    except OSError:
        return set()

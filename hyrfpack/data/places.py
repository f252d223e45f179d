"""Where in a folder poses and photos lie, for the ways in which programs and people arrange them."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from pathlib import Path

from hyrfpack.data.folder import list_photos, may_hold_photos, times_smaller
from hyrfpack.data.pictures import is_picture_name
from hyrfpack.errors import HyrfDataError

TABLES = ("cameras", "images", "points3D")
_PHOTO_FOLDERS = ("images", "image", "input", "inputs", "rgb", "photos", "photo", "pictures", "imgs", "img", "frames")
_WORKSPACES = ("colmap", "dense", "undistorted", "distorted")  # what COLMAP and its users call theirs
_NOT_OF_PHOTOS = (*_WORKSPACES, "sparse", "stereo")  # photos there are copies, or are of a set of its own
_DEEPEST, _MOST_FOLDERS = 3, 500  # how far a set is looked for below the folder given


def find_models(path: Path) -> list[Path]:
    """The folders below `path` that hold a COLMAP model, see `find_workspace`; none where there is none.

    Raises:
        HyrfDataError: a folder `sparse` or one in it may not be read.
    """
    return find_workspace(path)[1]


def find_workspace(path: Path) -> tuple[Path, list[Path]]:
    """The folder that a reconstruction lies in, and its models: those in `sparse/` by number, then by name, then
    `sparse/` itself, then the folder itself.

    It is `path`, or a folder such as `dense/` or `dense/0/` in it; the first with photos of its own, if any has some.

    Raises:
        HyrfDataError: a folder `sparse` or one in it may not be read.
    """
    bases = [path]
    for name in _WORKSPACES:
        bases += [path / name, *_subfolders(path / name)]
    found = [(base, models) for base in bases if (models := _models_in(base))]
    if len(found) < 2:
        return found[0] if found else (path, [])
    own = [(base, models) for base, models in found if (photos := find_photo_folder(base)) and _holds_photos(photos)]
    return (own or found)[0]


def find_photo_folder(path: Path) -> Path | None:
    """The folder of a set's photos.

    `images`, or its least reduced copy (`images_2`), or another usual name, or `path` itself, or the one other folder
    in it that holds pictures; None where that leaves none, or a choice.
    """
    inside = {entry.name.casefold(): entry for entry in _subfolders(path)}
    copies = sorted((times, name) for name in inside if (times := times_smaller(name)))
    usual = [*_PHOTO_FOLDERS[:1], *(name for _, name in copies), *_PHOTO_FOLDERS[1:]]
    named = [inside[name] for name in usual if name in inside]
    for folder in named:
        if _holds_photos(folder):
            return folder
    if any(is_picture_name(name) and not name.lower().startswith("mask.") for name in _names(path)):
        return path
    if named:
        return named[0]  # empty, or of pictures of a kind that cannot be read, which reading it says
    others = [
        entry
        for name, entry in inside.items()
        if name not in _NOT_OF_PHOTOS and may_hold_photos(name) and _holds_photos(entry)
    ]
    return others[0] if len(others) == 1 else None


def find_set(path: Path, holds: Callable[[Path], bool]) -> Path | None:
    """The folder below `path` that alone `holds` a set, as an archive's one top folder does; None where none does.

    Raises:
        HyrfDataError: several do.
    """
    level = [path]
    for _ in range(_DEEPEST):
        level = [inside for folder in level for inside in _subfolders(folder)][:_MOST_FOLDERS]
        sets = [folder for folder in level if holds(folder)]
        if len(sets) > 1:
            some = ", ".join(str(folder.relative_to(path)) for folder in sets[:4])
            raise HyrfDataError(
                f"{path}: holds {len(sets)} sets of photos with poses ({some}{', ...' if len(sets) > 4 else ''}); "
                "give the folder of one of them"
            )
        if sets:
            return sets[0]
    return None


def folders_of(path: Path) -> str:
    """The folders in a folder in words, for sentences that ask for one of them."""
    there = [entry.name for entry in _subfolders(path)]
    if len(there) == 1:
        return f"the only folder there is {there[0]}"
    return f"there are the folders {', '.join(there)}" if there else "there is no folder in it"


def _models_in(base: Path) -> list[Path]:
    def holds_model(folder: Path) -> bool:
        return any(os.path.isfile(folder / f"{table}{kind}") for table in TABLES for kind in (".bin", ".txt"))

    inside = _subfolders(base / "sparse")
    for folder in (base / "sparse", *inside):
        if os.path.isdir(folder) and not os.access(folder, os.R_OK | os.X_OK):
            raise HyrfDataError(f"{folder}: the folder may not be read; check its permissions")
    inside.sort(key=lambda entry: (int(entry.name) if entry.name.isdecimal() else math.inf, entry.name))
    models = [folder for folder in (*inside, base / "sparse") if holds_model(folder)]
    return models or [base] * holds_model(base)


def _holds_photos(folder: Path) -> bool:
    if any(is_picture_name(name) for name in _names(folder)):  # most do, and no file needs to be looked at then
        return True
    try:
        return bool(list_photos(folder))
    except HyrfDataError:  # a folder that may not be read, which is no trouble unless it is the one
        return False


def _subfolders(folder: Path) -> list[Path]:
    """Sorted, without hidden ones; none where there is no such folder or it cannot be read."""
    names = (name for name in sorted(_names(folder)) if not name.startswith((".", "__")))
    return [folder / name for name in names if os.path.isdir(folder / name)]


def _names(folder: Path) -> list[str]:
    try:
        return os.listdir(folder)
    except OSError:
        return []

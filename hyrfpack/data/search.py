"""Search a folder for poses and photos in the arrangements that programs and people use."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from pathlib import Path

from hyrfpack.data.folder import downscale_factor, list_photos, may_hold_photos
from hyrfpack.data.pictures import is_picture_name
from hyrfpack.errors import HyrfDataError

COLMAP_TABLES = ("cameras", "images", "points3D")
_PHOTO_FOLDER_NAMES = (
    "images",
    "image",
    "input",
    "inputs",
    "rgb",
    "photos",
    "photo",
    "pictures",
    "imgs",
    "img",
    "frames",
)
_WORKSPACE_NAMES = ("colmap", "dense", "undistorted", "distorted")  # usual names of COLMAP workspaces
# Photos in these folders are copies, or belong to another dataset.
_NON_PHOTO_FOLDER_NAMES = (*_WORKSPACE_NAMES, "sparse", "stereo")
_MAX_SEARCH_DEPTH = 3
_MAX_FOLDERS_PER_LEVEL = 500


def find_models(path: Path) -> list[Path]:
    """List the folders below `path` that hold a COLMAP model, see `find_workspace`.

    Raises:
        HyrfDataError: a folder `sparse` or one in it may not be read.
    """
    return find_workspace(path)[1]


def find_workspace(path: Path) -> tuple[Path, list[Path]]:
    """Find the folder of a COLMAP reconstruction and its models.

    The folder is `path`, or one such as `dense/` or `dense/0/` in it. If there are several, it is the first that has
    photos of its own, or else the first. The models are the folders in `sparse/` by number, then by name, then
    `sparse/` itself, or the folder itself if there are none.

    Raises:
        HyrfDataError: a folder `sparse` or one in it may not be read.
    """
    bases = [path]
    for name in _WORKSPACE_NAMES:
        bases += [path / name, *_subfolders(path / name)]
    found = [(base, models) for base in bases if (models := _models_in(base))]
    if len(found) < 2:
        return found[0] if found else (path, [])
    with_photos = [
        (base, models) for base, models in found if (photos := find_photo_folder(base)) and _holds_photos(photos)
    ]
    return (with_photos or found)[0]


def find_photo_folder(path: Path) -> Path | None:
    """Find the folder of a dataset's photos, None if there is none or the choice is ambiguous.

    The candidates are, in order: `images`; its least downscaled copy (`images_2`); another usual name; `path` itself;
    the only other folder in `path` that holds pictures.
    """
    inside = {entry.name.casefold(): entry for entry in _subfolders(path)}
    copies = sorted((factor, name) for name in inside if (factor := downscale_factor(name)))
    usual = [*_PHOTO_FOLDER_NAMES[:1], *(name for _, name in copies), *_PHOTO_FOLDER_NAMES[1:]]
    named = [inside[name] for name in usual if name in inside]
    for folder in named:
        if _holds_photos(folder):
            return folder
    if any(is_picture_name(name) and not name.lower().startswith("mask.") for name in _list_names(path)):
        return path
    if named:
        return named[0]  # it is empty or its pictures are unreadable, which the reader reports
    others = [
        entry
        for name, entry in inside.items()
        if name not in _NON_PHOTO_FOLDER_NAMES and may_hold_photos(name) and _holds_photos(entry)
    ]
    return others[0] if len(others) == 1 else None


def find_only_subfolder(path: Path, has_poses: Callable[[Path], bool]) -> Path | None:
    """Find the only folder below `path` that has poses, None if there is none.

    Archives often have such a single top folder.

    Raises:
        HyrfDataError: several folders of one level have poses.
    """
    level = [path]
    for _ in range(_MAX_SEARCH_DEPTH):
        level = [inside for folder in level for inside in _subfolders(folder)][:_MAX_FOLDERS_PER_LEVEL]
        sets = [folder for folder in level if has_poses(folder)]
        if len(sets) > 1:
            some = ", ".join(str(folder.relative_to(path)) for folder in sets[:4])
            raise HyrfDataError(
                f"{path}: holds {len(sets)} sets of photos with poses ({some}{', ...' if len(sets) > 4 else ''})",
                fix="name the folder of one of them",
            )
        if sets:
            return sets[0]
    return None


def describe_subfolders(path: Path) -> str:
    """Describe the subfolders of a folder, for messages that ask the user to name one of them."""
    names = [entry.name for entry in _subfolders(path)]
    if len(names) == 1:
        return f"the only folder there is {names[0]}"
    return f"there are the folders {', '.join(names)}" if names else "there is no folder in it"


def _models_in(base: Path) -> list[Path]:
    """List the folders of COLMAP models in a workspace, see `find_workspace`."""

    def holds_model(folder: Path) -> bool:
        return any(os.path.isfile(folder / f"{table}{kind}") for table in COLMAP_TABLES for kind in (".bin", ".txt"))

    inside = _subfolders(base / "sparse")
    for folder in (base / "sparse", *inside):
        if os.path.isdir(folder) and not os.access(folder, os.R_OK | os.X_OK):
            raise HyrfDataError(f"{folder}: permission to read the folder is denied", fix="check its permissions")
    inside.sort(key=lambda entry: (int(entry.name) if entry.name.isdecimal() else math.inf, entry.name))
    models = [folder for folder in (*inside, base / "sparse") if holds_model(folder)]
    return models or [base] * holds_model(base)


def _holds_photos(folder: Path) -> bool:
    """Return whether a folder or one of its subfolders holds photos."""
    # In the usual case, photos lie in the folder itself, and no subfolder is searched.
    if any(is_picture_name(name) for name in _list_names(folder)):
        return True
    try:
        return bool(list_photos(folder))
    except HyrfDataError:  # an unreadable folder matters only if it is chosen, and then reading it fails
        return False


def _subfolders(folder: Path) -> list[Path]:
    """List the subfolders by name, without hidden ones; the list is empty if the folder cannot be read."""
    names = (name for name in sorted(_list_names(folder)) if not name.startswith((".", "__")))
    return [folder / name for name in names if os.path.isdir(folder / name)]


def _list_names(folder: Path) -> list[str]:
    """List the names in a folder; the list is empty if it cannot be read."""
    try:
        return os.listdir(folder)
    except OSError:
        return []

"""Photos and points that lie beside a table of poses: what the readers of other programs' exports share."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path, PurePosixPath

import numpy as np

from hyrfpack.data.assemble import Photo, check_found
from hyrfpack.data.masks import mask_folder
from hyrfpack.data.names import PictureIndex, parts_of, safe_name
from hyrfpack.data.pictures import Header, read_header
from hyrfpack.data.places import find_photo_folder, folders_of
from hyrfpack.data.points import read_ply
from hyrfpack.data.undistort import Lens
from hyrfpack.errors import HyrfDataError
from hyrfpack.scene import evenly_spaced

# Of a photo: its listed name, its lens (or what makes it of the file and its header), its pose, not checked.
Entry = tuple[str, Lens | Callable[[Path, Header], Lens], np.ndarray]

_LOOKED_AT = (2000, 20)  # points and cameras, spread over all, that tell whether they belong together
_FARTHEST = 1000  # times the extent of the cameras that half of the points may be away


def first_file(folder: Path, ending: str, is_one: Callable[[Path], bool]) -> Path | None:
    """The first file by name in a folder that has this ending, in any letter case, and is one by its content."""
    try:
        files = sorted(file for file in folder.iterdir() if file.suffix.lower() == ending and file.is_file())
        return next((file for file in files if is_one(file)), None)
    except OSError:
        return None


def picture_folder(path: Path, images: str | None) -> Path:
    """Where photos are: `images` if it is given, where they usually are if that is clear, or else anywhere below.

    Raises:
        HyrfDataError: there is no folder `images`.
    """
    if images is None:
        return find_photo_folder(path) or path
    if not os.path.isdir(path / images):  # Path.is_dir raises where a name is too long
        raise HyrfDataError(f"{path}: no photo folder '{images}'; {folders_of(path)}")
    return path / images


def listed_folder(path: Path, names: Iterable[str]) -> Path | None:
    """The folder in `path` that all listed names begin with, "images" of "images/a.jpg", if one of them is there."""
    parts = [parts_of(name) for name in names]
    folders = {part[0] if len(part) > 1 else "" for part in parts}
    alone = len(folders) == 1 and "" not in folders
    there = alone and any(os.path.isfile(path.joinpath(*part)) for part in parts)
    return path / folders.pop() if there else None


def photos_beside(
    path: Path, folder: Path, entries: Sequence[Entry], where: str
) -> tuple[list[Photo], Path, list[str]]:
    """The photos that a table lists.

    Args:
        path: the scene folder.
        folder: that the photos are in, `path` or below it; names may be said from either.
        entries: what the table says of each photo; the (4, 4) camera_from_world need not be checked.
        where: they are listed.

    Returns:
        The photos; the folder to look for masks in; notes.

    Raises:
        HyrfDataError: none is on disk, or a file is no picture.
    """
    pictures, shown = PictureIndex(folder), PurePosixPath(Path(os.path.relpath(folder, path)).as_posix())
    names = [safe_name(listed).removeprefix(f"{shown}/") for listed, _, _ in entries]
    matches = pictures.match(names)
    photos: list[Photo] = []
    missing: list[str] = []
    for name, (_, lens, pose) in zip(names, entries, strict=True):
        file = matches.found.get(name)
        if file is None:
            missing.append(str(shown / name))
            continue
        header = read_header(file)
        lens = lens(file, header) if callable(lens) else lens
        photos.append(Photo(pictures.name_of(file, name), file, header, lens, pose))
    notes = matches.notes + check_found(path, photos, missing, where, matches.unclear)
    return photos, mask_folder(path, folder.name), notes


def points_beside(path: Path, photos: Sequence[Photo], notes: list[str]) -> tuple[np.ndarray, np.ndarray, list[Path]]:
    """Points of the one `.ply` file in a folder, if there is one and the cameras look at them; notes say if not.

    Returns:
        (P, 3) positions, (P, 3) colours in [0, 1], P = 0 for none, and the file in a list.

    Raises:
        HyrfDataError: the file cannot be read.
    """
    none: tuple[np.ndarray, np.ndarray, list[Path]] = np.zeros((0, 3)), np.zeros((0, 3)), []
    files = sorted(file for file in path.iterdir() if file.suffix.lower() == ".ply" and file.is_file())
    if not files:
        return none
    if len(files) > 1:
        notes.append(f"there are {len(files)} .ply files and it is not said which holds the points; none is used")
        return none
    points, colors = read_ply(files[0])
    if not len(points) or not _belong(points, photos):
        notes.append(
            f"the points of {files[0].name} are not where the cameras look and are not used; "
            "export them in the coordinate system of the cameras"
        )
        return none
    return points, colors, [files[0]]


def _belong(points: np.ndarray, photos: Sequence[Photo]) -> bool:
    """Whether half of the points lie in or near the picture of a camera, and not beyond all reason."""
    sample = points[np.linspace(0, len(points) - 1, min(len(points), _LOOKED_AT[0])).astype(int)]
    cameras = evenly_spaced(photos, _LOOKED_AT[1])
    seen = np.zeros(len(sample), bool)
    with np.errstate(all="ignore"):
        stand = np.array([-photo.camera_from_world[:3, :3].T @ photo.camera_from_world[:3, 3] for photo in cameras])
        away = np.median(np.linalg.norm(sample - np.median(stand, axis=0), axis=1))
        extent = np.linalg.norm(np.ptp(stand, axis=0))
        for photo in cameras:
            local = sample @ photo.camera_from_world[:3, :3].T + photo.camera_from_world[:3, 3]
            lens = photo.lens
            u = lens.fx * local[:, 0] / local[:, 2] + lens.cx
            v = lens.fy * local[:, 1] / local[:, 2] + lens.cy
            near = (np.abs(u - lens.width / 2) < lens.width) & (np.abs(v - lens.height / 2) < lens.height)
            seen |= near & (local[:, 2] > 0)
    return bool(seen.mean() >= 0.5 and (extent == 0 or away <= _FARTHEST * extent))

"""Find photos and points beside a table of poses; shared by the readers of other programs' exports."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path, PurePosixPath

import numpy as np

from hyrfpack.data.assemble import PosedPhoto, missing_photos_notes
from hyrfpack.data.masks import find_mask_folder
from hyrfpack.data.names import PictureIndex, path_parts, safe_name
from hyrfpack.data.pictures import PictureHeader, read_header
from hyrfpack.data.points import read_ply_points
from hyrfpack.data.search import describe_subfolders, find_photo_folder
from hyrfpack.data.undistort import Lens
from hyrfpack.errors import HyrfDataError
from hyrfpack.scene import evenly_spaced

# A photo in a table: listed name, lens (or a function of the file and its header that returns one), unchecked pose.
PoseEntry = tuple[str, Lens | Callable[[Path, PictureHeader], Lens], np.ndarray]

# Points and cameras that are sampled to decide whether the points belong to the cameras.
_MAX_SAMPLED_POINTS = 2000
_MAX_SAMPLED_CAMERAS = 20
# Points whose median distance from the cameras is larger are taken for points of another coordinate system.
_MAX_POINT_DISTANCE_CAMERA_EXTENTS = 1000


def find_first_file(folder: Path, extension: str, is_wanted: Callable[[Path], bool]) -> Path | None:
    """Find the first file, in order of names, with this extension in any letter case that `is_wanted` accepts."""
    try:
        files = sorted(file for file in folder.iterdir() if file.suffix.lower() == extension and file.is_file())
        return next((file for file in files if is_wanted(file)), None)
    except OSError:
        return None


def find_picture_folder(path: Path, images: str | None) -> Path:
    """Find the folder of the photos: `images` if it is given, otherwise the usual one, otherwise `path` itself.

    Raises:
        HyrfDataError: the folder `images` does not exist.
    """
    if images is None:
        return find_photo_folder(path) or path
    if not os.path.isdir(path / images):  # Path.is_dir raises if a name is too long
        raise HyrfDataError(
            f"{path}: there is no photo folder '{images}', and {describe_subfolders(path)}",
            fix="name another folder of photos with `images`",
        )
    return path / images


def find_listed_folder(path: Path, names: Iterable[str]) -> Path | None:
    """Find the folder in `path` that all listed names begin with, such as "images" in "images/a.jpg".

    It returns None if the names share no such folder, or if none of the listed photos exists.
    """
    parts = [path_parts(name) for name in names]
    folders = {part[0] if len(part) > 1 else "" for part in parts}
    is_shared = len(folders) == 1 and "" not in folders
    exists = is_shared and any(os.path.isfile(path.joinpath(*part)) for part in parts)
    return path / folders.pop() if exists else None


def find_listed_photos(
    path: Path, folder: Path, entries: Sequence[PoseEntry], where: str
) -> tuple[list[PosedPhoto], Path, list[str]]:
    """Find the files of the photos that a table lists and read their headers.

    Args:
        path: the scene folder.
        folder: the folder of the photos, `path` or below it; listed names may be relative to either.
        entries: name, lens and pose of each photo; the (4, 4) camera_from_world may be unchecked.
        where: the file that lists the photos, for messages.

    Returns:
        The photos; the folder to search for masks; notes.

    Raises:
        HyrfDataError: no photo is on disk, or a file is no picture.
    """
    pictures, relative_folder = PictureIndex(folder), PurePosixPath(Path(os.path.relpath(folder, path)).as_posix())
    names = [safe_name(listed).removeprefix(f"{relative_folder}/") for listed, _, _ in entries]
    matches = pictures.match(names)
    photos: list[PosedPhoto] = []
    missing: list[str] = []
    for name, (_, lens, pose) in zip(names, entries, strict=True):
        file = matches.found.get(name)
        if file is None:
            missing.append(str(relative_folder / name))
            continue
        header = read_header(file)
        lens = lens(file, header) if callable(lens) else lens
        photos.append(PosedPhoto(pictures.photo_name(file, name), file, header, lens, pose))
    notes = matches.notes + missing_photos_notes(path, photos, missing, where, matches.ambiguous)
    masks = find_mask_folder(path, folder.name)
    beside = masks if folder == path else find_mask_folder(folder.parent, folder.name)
    return photos, beside if beside.is_dir() else masks, notes


def read_sidecar_points(
    path: Path, photos: Sequence[PosedPhoto], notes: list[str]
) -> tuple[np.ndarray, np.ndarray, list[Path]]:
    """Read the points of the only `.ply` file in a folder, if the cameras look at them.

    Notes are added if there are several files, or if the cameras do not look at the points.

    Returns:
        (P, 3) positions, (P, 3) colours in [0, 1], and a list of the file; P is 0 and the list empty without points.

    Raises:
        HyrfDataError: the file cannot be read.
    """
    none: tuple[np.ndarray, np.ndarray, list[Path]] = np.zeros((0, 3)), np.zeros((0, 3)), []
    files = sorted(file for file in path.iterdir() if file.suffix.lower() == ".ply" and file.is_file())
    if not files:
        return none
    if len(files) > 1:
        notes.append(
            f"there are {len(files)} .ply files, of which any may hold the points of the cameras, so none is used"
        )
        return none
    points, colors = read_ply_points(files[0])
    if not len(points) or not _are_in_view(points, photos):
        notes.append(
            f"the points of {files[0].name} do not lie where the cameras look and are not used; "
            "export them in the coordinate system of the cameras"
        )
        return none
    return points, colors, [files[0]]


def _are_in_view(points: np.ndarray, photos: Sequence[PosedPhoto]) -> bool:
    """Return whether half of the points lie in or near the picture of a camera and at a plausible distance."""
    sampled = points[np.linspace(0, len(points) - 1, min(len(points), _MAX_SAMPLED_POINTS)).astype(int)]
    cameras = evenly_spaced(photos, _MAX_SAMPLED_CAMERAS)
    seen = np.zeros(len(sampled), bool)
    with np.errstate(all="ignore"):
        positions = np.array([-photo.camera_from_world[:3, :3].T @ photo.camera_from_world[:3, 3] for photo in cameras])
        distance = np.median(np.linalg.norm(sampled - np.median(positions, axis=0), axis=1))
        extent = np.linalg.norm(np.ptp(positions, axis=0))
        for photo in cameras:
            local = sampled @ photo.camera_from_world[:3, :3].T + photo.camera_from_world[:3, 3]
            lens = photo.lens
            u = lens.fx * local[:, 0] / local[:, 2] + lens.cx
            v = lens.fy * local[:, 1] / local[:, 2] + lens.cy
            near = (np.abs(u - lens.width / 2) < lens.width) & (np.abs(v - lens.height / 2) < lens.height)
            seen |= near & (local[:, 2] > 0)
    return bool(seen.mean() >= 0.5 and (extent == 0 or distance <= _MAX_POINT_DISTANCE_CAMERA_EXTENTS * extent))

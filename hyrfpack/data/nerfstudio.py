"""Read nerfstudio and instant-ngp datasets: one transforms.json with shared or per-frame intrinsics."""

from __future__ import annotations

import os
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from hyrfpack.cameras.files import focal_entries
from hyrfpack.data.assemble import PosedPhoto, assemble_scene, missing_photos_notes
from hyrfpack.data.equirectangular import panorama_lens
from hyrfpack.data.masks import find_mask_folder
from hyrfpack.data.names import NameMatches, PictureIndex, path_parts, safe_name
from hyrfpack.data.pictures import read_header
from hyrfpack.data.points import read_ply_points
from hyrfpack.data.search import find_photo_folder
from hyrfpack.data.sidecar_files import find_picture_folder
from hyrfpack.data.transforms import frame_lens, pose_from_opengl, read_transforms, with_forward_slashes
from hyrfpack.errors import HyrfDataError
from hyrfpack.scene import Scene

_PANORAMA_MODEL = "EQUIRECTANGULAR"


def read_nerfstudio(path: Path, *, test_every: int, images: str | None, max_size: int) -> Scene:
    """Read a folder with a transforms.json.

    World coordinates are those of the file's matrices. `applied_transform` is ignored: it describes the rotation from
    the reconstruction's frame, which poses and the points of `ply_file_path` already include. EQUIRECTANGULAR frames
    become the faces of a cube. Depth maps are not read.

    Args:
        path: the scene folder.
        test_every: see `load_scene`; `train_filenames`, `val_filenames` and `test_filenames` take precedence.
        images: a folder to take the photos from, instead of the one that the frames name.
        max_size: see `load_scene`.

    Raises:
        HyrfDataError: a file is missing or cannot be used.
    """
    file = path / "transforms.json"
    content = read_transforms(file)
    frames = content["frames"]
    if images is not None:
        find_picture_folder(path, images)
    keep, test_names, notes = _read_split(content, file)
    frames = [frame for frame in frames if keep is None or PurePosixPath(frame["file_path"]) in keep]
    strip = _common_folder([frame["file_path"] for frame in content["frames"]])
    pictures, matches = _find_pictures(path, [frame["file_path"] for frame in frames], strip, images)
    is_moved = pictures != path and pictures.name != strip.name
    masks = PictureIndex(path, photos=False)
    if is_moved and images is None:
        where = "the folder itself" if pictures == path else pictures.name
        notes.append(f"the photos are not where {file.name} says; those in {where} are used")
    photos: list[PosedPhoto] = []
    missing: list[str] = []
    test: set[str] = set()
    for frame in frames:
        listed = PurePosixPath(frame["file_path"])
        picture = matches.found.get(str(listed))
        if picture is None:
            missing.append(str(listed if images is None else PurePosixPath(images, _strip_folder(listed, strip))))
            continue
        header = read_header(picture)
        name = _photo_name(picture, pictures, listed, strip)
        if listed in test_names:
            test.add(name)
        if frame.get("camera_model", content.get("camera_model")) == _PANORAMA_MODEL:
            lens = panorama_lens(picture, header)
        else:
            if is_moved:
                _check_scale_is_known(content, frame, file)
            lens = frame_lens(content, frame, header, file)
        mask = _listed_mask(masks, frame, name, file)
        photos.append(PosedPhoto(name, picture, header, lens, pose_from_opengl(frame, file), mask))
    notes += matches.notes
    notes += missing_photos_notes(path, photos, missing, file.name, matches.ambiguous)
    points, colors = _read_points(path, content, file)
    tables = [file] if points is None else [file, path / with_forward_slashes(content["ply_file_path"])]
    return assemble_scene(
        path,
        "nerfstudio",
        photos,
        test_every=test_every,
        max_size=max_size,
        test_names=None if keep is None else test,
        points=points,
        point_colors=colors,
        tables=tables,
        masks=find_mask_folder(path, pictures.name if is_moved else strip.name),
        notes=notes,
    )


def _read_split(content: dict[str, Any], file: Path) -> tuple[set | None, set, list[str]]:
    """Read the file's own split.

    Returns:
        Listed paths to keep (None for all), the held-out ones among them, and a note if only one side is listed or if
        photos are in neither.
    """
    lists = {}
    for key in ("train_filenames", "val_filenames", "test_filenames"):
        names = content.get(key) or []
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise HyrfDataError(f"{file}: '{key}' is not a list of file names", fix="correct or remove it")
        lists[key] = {PurePosixPath(with_forward_slashes(name)) for name in names}
    train, val, test = lists.values()
    held_out = test or val
    if not train or not held_out:
        listed = [key for key, names in lists.items() if names]
        note = f"{file.name} lists {' and '.join(listed)} alone, which is half a split and is not used"
        return None, set(), [note] if listed else []
    keep, frames = train | held_out, content["frames"]
    unused = sum(PurePosixPath(frame["file_path"]) not in keep for frame in frames)
    held_out_key = "test_filenames" if test else "val_filenames"
    note = (
        f"{unused} of {len(frames)} photos are not used: they are neither in train_filenames nor in {held_out_key} of "
        f"{file.name}"
    )
    return keep, held_out, [note] if unused else []


def _common_folder(listed: list[str]) -> PurePosixPath:
    """Return the first folder that all frames share ("images"), which is not part of a photo's name."""
    firsts = {PurePosixPath(name).parts[:1] for name in listed if len(PurePosixPath(name).parts) > 1}
    has_bare_name = any(len(PurePosixPath(name).parts) < 2 for name in listed)
    first = PurePosixPath(*next(iter(firsts))) if len(firsts) == 1 and not has_bare_name else PurePosixPath()
    is_folder = path_parts(str(first)) or first.name == ".."  # a root or a drive is not a folder
    return first if is_folder else PurePosixPath()


def _find_pictures(path: Path, listed: list[str], strip: PurePosixPath, images: str | None) -> tuple[Path, NameMatches]:
    """Find the files of listed paths, and the folder that the paths are relative to.

    The paths are searched as listed. If `images` is given, or nothing is found there, they are searched without their
    first folder, in `images` or in the usual folder of photos.
    """
    listed = [str(PurePosixPath(name)) for name in listed]
    if images is None:
        matches = PictureIndex(path).match(listed)
        elsewhere = None if matches.found or matches.ambiguous else find_photo_folder(path)
        if elsewhere is None:
            return path, matches
    else:
        elsewhere = path / images
    short = {name: _strip_folder(PurePosixPath(name), strip) for name in listed}
    found = PictureIndex(elsewhere).match(short.values())
    names = {name: file for name in listed if (file := found.found.get(short[name])) is not None}
    inexact = [name for name in listed if short[name] in found.inexact]
    ambiguous = [name for name in listed if short[name] in found.ambiguous]
    return elsewhere, NameMatches(elsewhere, names, inexact, ambiguous)


def _strip_folder(listed: PurePosixPath, strip: PurePosixPath) -> str:
    """Remove the shared first folder from a listed path, and any parts that would lead out of a folder."""
    return safe_name(str(listed.relative_to(strip) if strip.parts else listed))


def _photo_name(picture: Path, folder: Path, listed: PurePosixPath, strip: PurePosixPath) -> str:
    """Return a photo's name, its path below the folder of photos."""
    for top in (folder / strip, folder):
        if picture.is_relative_to(top) and ".." not in picture.relative_to(top).parts:
            return picture.relative_to(top).as_posix()
    return _strip_folder(listed, strip)


def _check_scale_is_known(content: dict[str, Any], frame: dict[str, Any], file: Path) -> None:
    """Raise HyrfDataError if focal lengths cannot be scaled to photos from another folder, which may be smaller.

    Scaling needs 'w', the calibrated width, or an angle of view, which counts only where no focal length is stated.
    """
    stated = {name for name, value in focal_entries(frame, content).items() if value is not None}
    is_angle = "camera_angle_x" in stated and stated.isdisjoint({"fl_x", "fl_y"})
    if {**content, **frame}.get("w") is None and not is_angle:
        raise HyrfDataError(
            f"{file}: there is no 'w' and 'h', so that focal lengths cannot be scaled to the photos of another folder",
            fix="add the width and height of the calibration",
        )


def _listed_mask(masks: PictureIndex, frame: dict[str, Any], name: str, file: Path) -> Path | None:
    """Find the mask that a frame names, None if it names none."""
    listed = frame.get("mask_path")
    if listed is None:
        return None
    mask = masks.find(with_forward_slashes(listed)) if isinstance(listed, str) else None
    if mask is None:
        raise HyrfDataError(
            f"{file}: mask {str(listed)[:80]} of {name} is not on disk",
            fix="restore it, or remove 'mask_path'",
        )
    return mask


def _read_points(path: Path, content: dict[str, Any], file: Path) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Read the points of `ply_file_path` and their colours, None if the file names none."""
    listed = content.get("ply_file_path")
    if listed is None:
        return None, None
    ply = path / with_forward_slashes(str(listed))
    if not isinstance(listed, str) or not os.path.isfile(ply):  # Path.is_file raises if a name is too long
        raise HyrfDataError(
            f"{file}: points {str(listed)[:80]} are not on disk",
            fix="restore them, or remove 'ply_file_path'",
        )
    return read_ply_points(ply)

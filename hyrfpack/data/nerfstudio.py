"""nerfstudio and instant-ngp sets: one transforms.json, intrinsics for all or for each frame."""

from __future__ import annotations

import os
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from hyrfpack.data.assemble import Photo, check_found, make_scene
from hyrfpack.data.equirectangular import panorama_lens
from hyrfpack.data.masks import mask_folder
from hyrfpack.data.names import Matches, PictureIndex, parts_of, safe_name
from hyrfpack.data.pictures import Header, read_header
from hyrfpack.data.places import find_photo_folder, folders_of
from hyrfpack.data.points import read_ply
from hyrfpack.data.transforms import focal_from_angle, number, pose_from_opengl, read_json, slashed
from hyrfpack.data.undistort import Lens, brown
from hyrfpack.errors import HyrfDataError
from hyrfpack.scene import Scene

_PERSPECTIVE = ("OPENCV", "FULL_OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE")
_FISHEYE = ("OPENCV_FISHEYE", "RADIAL_FISHEYE", "SIMPLE_RADIAL_FISHEYE")
_PANORAMA = "EQUIRECTANGULAR"
_DENOMINATOR = ("k4", "k5", "k6")


def read_nerfstudio(path: Path, *, test_every: int, images: str | None, max_size: int) -> Scene:
    """Read a folder with a transforms.json.

    The world is that of the file's matrices. `applied_transform` says how it was turned from the reconstruction's
    frame; poses and the points of `ply_file_path` are both already turned, so nothing is left to do. EQUIRECTANGULAR
    frames become the faces of a cube; depth maps are not read.

    Args:
        path: the scene folder.
        test_every: see `load_scene`; `train_filenames`, `val_filenames`, `test_filenames` come first.
        images: a folder to take the photos from instead of the one the frames name.
        max_size: see `load_scene`.

    Raises:
        HyrfDataError: a file is missing or cannot be used.
    """
    file = path / "transforms.json"
    content = read_json(file)
    frames = content["frames"]
    if images is not None and not (path / images).is_dir():
        raise HyrfDataError(f"{path}: no photo folder '{images}'; {folders_of(path)}")
    keep, test_names, notes = _own_split(content, file)
    frames = [frame for frame in frames if keep is None or PurePosixPath(frame["file_path"]) in keep]
    strip = _common_folder([frame["file_path"] for frame in content["frames"]])
    pictures, matches = _find_pictures(path, [frame["file_path"] for frame in frames], strip, images)
    moved = pictures != path and pictures.name != strip.name
    masks = PictureIndex(path, photos=False)
    if moved and images is None:
        where = "the folder itself" if pictures == path else pictures.name
        notes.append(f"the photos are not where {file.name} says; those in {where} were taken")
    photos: list[Photo] = []
    missing: list[str] = []
    test: set[str] = set()
    for frame in frames:
        listed = PurePosixPath(frame["file_path"])
        picture = matches.found.get(str(listed))
        if picture is None:
            missing.append(str(listed if images is None else PurePosixPath(images, _below(listed, strip))))
            continue
        header = read_header(picture)
        name = _name(picture, pictures, listed, strip)
        if listed in test_names:
            test.add(name)
        if frame.get("camera_model", content.get("camera_model")) == _PANORAMA:
            lens = panorama_lens(picture, header)
        else:
            if moved:
                _check_scale_is_known(content, frame, file)
            lens = _lens(content, frame, header, file)
        mask = _listed_mask(masks, frame, name, file)
        photos.append(Photo(name, picture, header, lens, pose_from_opengl(frame, file), mask))
    notes += matches.notes
    notes += check_found(path, photos, missing, file.name, matches.unclear)
    points, colors = _read_points(path, content, file)
    tables = [file] if points is None else [file, path / slashed(content["ply_file_path"])]
    return make_scene(
        path,
        "nerfstudio",
        photos,
        test_every=test_every,
        max_size=max_size,
        test_names=None if keep is None else test,
        points=points,
        point_colors=colors,
        tables=tables,
        masks=mask_folder(path, pictures.name if moved else strip.name),
        notes=notes,
    )


def _own_split(content: dict[str, Any], file: Path) -> tuple[set | None, set, list[str]]:
    """Listed paths to keep (None: all), among them those held out, and a note on half a split."""
    lists = {}
    for key in ("train_filenames", "val_filenames", "test_filenames"):
        names = content.get(key) or []
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise HyrfDataError(f"{file}: '{key}' is not a list of file names; correct or remove it")
        lists[key] = {PurePosixPath(slashed(name)) for name in names}
    train, val, test = lists.values()
    held_out = test or val
    if not train or not held_out:
        given = [key for key, names in lists.items() if names]
        half = f"{file.name} lists {' and '.join(given)} alone, which is half a split and is not used"
        return None, set(), [half] if given else []
    return train | held_out, held_out, []


def _common_folder(listed: list[str]) -> PurePosixPath:
    """The first folder of all frames ("images"), which is no part of a photo's name."""
    firsts = {PurePosixPath(name).parts[:1] for name in listed if len(PurePosixPath(name).parts) > 1}
    alone = any(len(PurePosixPath(name).parts) < 2 for name in listed)
    first = PurePosixPath(*next(iter(firsts))) if len(firsts) == 1 and not alone else PurePosixPath()
    return first if parts_of(str(first)) or first.name == ".." else PurePosixPath()  # no root, no drive


def _find_pictures(path: Path, listed: list[str], strip: PurePosixPath, images: str | None) -> tuple[Path, Matches]:
    """The folder that names count from, and the file of each listed path: where the frames say, or else in `images` or
    where photos usually are, by their names below the first folder."""
    listed = [str(PurePosixPath(name)) for name in listed]
    if images is None:
        matches = PictureIndex(path).match(listed)
        elsewhere = None if matches.found or matches.unclear else find_photo_folder(path)
        if elsewhere is None:
            return path, matches
    else:
        elsewhere = path / images
    short = {name: _below(PurePosixPath(name), strip) for name in listed}
    found = PictureIndex(elsewhere).match(short.values())
    names = {name: file for name in listed if (file := found.found.get(short[name])) is not None}
    loose, unclear = ([name for name in listed if short[name] in few] for few in (found.loose, found.unclear))
    return elsewhere, Matches(elsewhere, names, loose, unclear)


def _below(listed: PurePosixPath, strip: PurePosixPath) -> str:
    """A listed path without the first folder that all share, and without what would lead out of a folder."""
    return safe_name(str(listed.relative_to(strip) if strip.parts else listed))


def _name(picture: Path, folder: Path, listed: PurePosixPath, strip: PurePosixPath) -> str:
    """A photo's name: its path below the folder of photos."""
    for top in (folder / strip, folder):
        if picture.is_relative_to(top) and ".." not in picture.relative_to(top).parts:
            return picture.relative_to(top).as_posix()
    return _below(listed, strip)


def _check_scale_is_known(content: dict[str, Any], frame: dict[str, Any], file: Path) -> None:
    """Photos of another folder may be smaller than those calibrated, which only 'w' tells, or an angle of view."""
    entries = {**content, **frame}
    if entries.get("w") is None and entries.get("camera_angle_x") is None:
        raise HyrfDataError(
            f"{file}: has no 'w' and 'h', so focal lengths cannot be brought to the size of photos of another folder; "
            "add the size that was calibrated"
        )


def _lens(content: dict[str, Any], frame: dict[str, Any], header: Header, file: Path) -> Lens:
    """The frame's intrinsics where it has its own, the file's otherwise."""

    def value(key: str) -> float | None:
        own = number(frame, key, file)
        return own if own is not None else number(content, key, file)

    where = f"{file}: frame {frame['file_path'][:80]}"
    width, height = int(value("w") or header.width), int(value("h") or header.height)
    fx, fy = value("fl_x"), value("fl_y")
    angle_x, angle_y = value("camera_angle_x"), value("camera_angle_y")
    if fx is None and angle_x is not None:
        fx = focal_from_angle(angle_x, width, file)
    if fy is None:
        fy = focal_from_angle(angle_y, height, file) if angle_y is not None and value("fl_x") is None else fx
    if fx is None:
        fx = fy
    if fx is None or fy is None:
        raise HyrfDataError(f"{where} has neither 'fl_x' nor 'camera_angle_x'; add its focal length")
    cx, cy = value("cx"), value("cy")
    pinhole = (width, height, fx, fy, width / 2 if cx is None else cx, height / 2 if cy is None else cy)

    model = frame.get("camera_model", content.get("camera_model", "OPENCV"))
    if frame.get("is_fisheye", content.get("is_fisheye", False)):
        model = "OPENCV_FISHEYE"
    k1, k2, k3, k4, k5, k6, p1, p2 = (value(key) or 0.0 for key in ("k1", "k2", "k3", *_DENOMINATOR, "p1", "p2"))
    if model in _FISHEYE:
        return Lens(*pinhole, "fisheye", (k1, k2, k3, k4))
    if model not in _PERSPECTIVE:
        raise HyrfDataError(f"{where} has camera model {str(model)[:40]!r}, which is not supported; undistort it first")
    if model in ("PINHOLE", "SIMPLE_PINHOLE"):
        return Lens(*pinhole)
    if model != "FULL_OPENCV" and (k4 or k5 or k6):
        raise HyrfDataError(
            f"{where} has 'k4' or more, which camera model {model} does not define; "
            "say FULL_OPENCV (rational) or OPENCV_FISHEYE, or set it to 0"
        )
    return Lens(*pinhole, "brown", brown(k1, k2, p1, p2, k3, k4, k5, k6))


def _listed_mask(masks: PictureIndex, frame: dict[str, Any], name: str, file: Path) -> Path | None:
    listed = frame.get("mask_path")
    if listed is None:
        return None
    mask = masks.find(slashed(listed)) if isinstance(listed, str) else None
    if mask is None:
        raise HyrfDataError(f"{file}: mask {str(listed)[:80]} of {name} is not on disk; restore it or drop 'mask_path'")
    return mask


def _read_points(path: Path, content: dict[str, Any], file: Path) -> tuple[np.ndarray | None, np.ndarray | None]:
    listed = content.get("ply_file_path")
    if listed is None:
        return None, None
    ply = path / slashed(str(listed))
    if not isinstance(listed, str) or not os.path.isfile(ply):  # Path.is_file raises where a name is too long
        raise HyrfDataError(f"{file}: points {str(listed)[:80]} are not on disk; restore them or drop 'ply_file_path'")
    return read_ply(ply)

"""Read COLMAP reconstructions (cameras, images and points3D as .bin or .txt, usually in `sparse/0`) with pycolmap."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import numpy as np

from hyrfpack.colmap_library import load_pycolmap
from hyrfpack.counts import format_count
from hyrfpack.data.assemble import PosedPhoto, assemble_scene, missing_photos_notes, unregistered_note
from hyrfpack.data.colmap_binary import check_binary_model
from hyrfpack.data.colmap_repair import read_image_names, readable_model
from hyrfpack.data.folder import downscale_factor
from hyrfpack.data.masks import find_mask_folder
from hyrfpack.data.names import PictureIndex, safe_name
from hyrfpack.data.pictures import read_header
from hyrfpack.data.points import read_ply_points
from hyrfpack.data.search import COLMAP_TABLES, describe_subfolders, find_photo_folder, find_workspace
from hyrfpack.data.sidecar_files import find_picture_folder
from hyrfpack.data.undistort import Lens, brown_coefficients
from hyrfpack.errors import HyrfDataError, short_reason
from hyrfpack.scene import Scene


class _Image(NamedTuple):
    """A registered photo of a model.

    `visible_points` are rows of the model's points, None if the points come from another file.
    """

    name: str
    camera: int
    camera_from_world: np.ndarray
    visible_points: np.ndarray | None


def read_colmap(path: Path, *, test_every: int, images: str | None, model: str | None, max_size: int) -> Scene:
    """Read a folder with a COLMAP model and its photos.

    Args:
        path: the scene folder.
        test_every, max_size: see `load_scene`.
        images: the folder of photos; None takes the one that `find_photo_folder` finds. Intrinsics are scaled to the
            size of the files in it.
        model: name of the folder of the model; None takes the model with the most photos.

    Returns:
        The scene, in the coordinate frame and units of the model.

    Raises:
        HyrfDataError: the model or the photos cannot be used.
    """
    base, models = find_workspace(path)
    tables, notes = _choose_model(path, models, model)
    cameras, posed, unposed, points, colors = _read_model(tables)
    names = [safe_name(image.name) for image in posed]
    folder = _photo_folder(path, base, images, names)
    relative_folder = Path(os.path.relpath(folder, path))  # may start with ".."
    if base not in (path, path / "colmap"):
        notes.append(f"poses are read from {tables.relative_to(path)}")
    if images is None and relative_folder != Path("images"):
        smaller = (
            "; these are smaller copies, and the intrinsics are scaled to them" if downscale_factor(folder.name) else ""
        )
        notes.append(f"photos are read from {'the folder itself' if folder == path else relative_folder}{smaller}")
    if unposed:
        notes.append(unregistered_note(unposed))
    if not len(points):
        notes.append(
            f"the model in {tables.relative_to(path)} has no points; training finds surfaces without them, or starts "
            "from random positions"
        )
    pictures = PictureIndex(folder)
    matches = pictures.match(names)
    photos: list[PosedPhoto] = []
    missing: list[str] = []
    for name, image in zip(names, posed, strict=True):
        file = matches.found.get(name)
        if file is None:
            missing.append(str(PurePosixPath(relative_folder) / name))
            continue
        lens, pose = cameras[image.camera], image.camera_from_world
        listed_name = pictures.photo_name(file, name)
        visible = image.visible_points
        photos.append(PosedPhoto(listed_name, file, read_header(file), lens, pose, visible_points=visible))
    notes += matches.notes
    notes += missing_photos_notes(path, photos, missing, str(tables.relative_to(path)), matches.ambiguous)
    return assemble_scene(
        path,
        "colmap",
        photos,
        test_every=test_every,
        max_size=max_size,
        points=points,
        point_colors=colors,
        tables=sorted(file for file in tables.iterdir() if file.is_file()),
        masks=find_mask_folder(path if folder == path else folder.parent, folder.name),
        notes=notes,
    )


def _photo_folder(path: Path, base: Path, images: str | None, names: Sequence[str]) -> Path:
    """Find the folder of the photos: `images` if it is given, otherwise one in the workspace or in the scene folder."""
    if images is not None:
        holder = next((parent for parent in (path, base) if os.path.isdir(parent / images)), path)
        return find_picture_folder(holder, images)
    found = find_photo_folder(base) or find_photo_folder(path)
    if found is None:  # the cameras of a rig have one folder each, and the listed names begin with these folders
        found = next((parent for parent in (base, path) if any(os.path.isfile(parent / name) for name in names)), None)
    if found is None:
        raise HyrfDataError(
            f"{path}: there is no photo folder 'images' beside the COLMAP model, and no other folder is clearly the "
            f"right one ({describe_subfolders(path)})",
            fix="choose the folder of photos with `images`, or name the folder that holds both",
        )
    return found


def _choose_model(path: Path, models: Sequence[Path], name: str | None) -> tuple[Path, list[str]]:
    """Choose the model of this name, or the one with the most photos; also return a note if there are several."""
    if not models:
        raise HyrfDataError(
            f"{path}: there is no COLMAP model in sparse or colmap/sparse", fix="run the reconstruction first"
        )
    if name is None and len(models) == 1:
        return models[0], []
    sizes = {model: _count_registered_photos(model) for model in models}
    listed = ", ".join(f"{model.name} ({format_count(size, 'photo')})" for model, size in sizes.items())
    chosen = max(models, key=lambda model: sizes[model])  # max returns the first of several models of the same size
    reason = "because it has the most photos; 'hyrfpack train' selects another with `model`"
    if name is not None:
        named = [model for model in models if model.name == name]
        if not named:
            raise HyrfDataError(
                f"{path}: there is no COLMAP model '{name}'",
                fix=f"choose one of these: {listed}",
            )
        chosen, reason = named[0], "as requested"
    return chosen, [f"there are {len(models)} COLMAP models: {listed}; {chosen.name} is used, {reason}"]


def _count_registered_photos(model: Path) -> int:
    """Return the number of registered photos that a model states, 0 if it cannot be read.

    Reading the model later reports why it cannot be read.
    """
    try:
        if (model / "images.bin").is_file():
            with (model / "images.bin").open("rb") as table:
                return int.from_bytes(table.read(8), "little")
        stated = _stated_count(model / "images.txt")
        if stated is not None:
            return stated
        with (model / "images.txt").open(encoding="utf-8-sig", errors="replace") as lines:
            return (sum(not line.startswith("#") for line in lines) + 1) // 2  # each photo has two lines
    except OSError:
        return 0


def lens_from_colmap(model: str, width: int, height: int, params: np.ndarray) -> Lens:
    """Convert a COLMAP camera to a lens.

    Args:
        model: COLMAP's name of the camera model.
        width, height: picture size in pixels.
        params: parameters in COLMAP's order for that model.

    Raises:
        HyrfDataError: the camera model is neither a perspective one nor a polynomial fisheye.
    """
    p = [float(value) for value in params]
    match model:
        case "SIMPLE_PINHOLE":
            return Lens(width, height, p[0], p[0], p[1], p[2])
        case "PINHOLE":
            return Lens(width, height, p[0], p[1], p[2], p[3])
        case "SIMPLE_RADIAL" | "RADIAL":
            return Lens(width, height, p[0], p[0], p[1], p[2], "brown", brown_coefficients(*p[3:]))
        case "OPENCV" | "FULL_OPENCV":
            return Lens(width, height, p[0], p[1], p[2], p[3], "brown", brown_coefficients(*p[4:]))
        case "SIMPLE_RADIAL_FISHEYE" | "RADIAL_FISHEYE":
            k1, k2 = (*p[3:], 0.0)[:2]
            return Lens(width, height, p[0], p[0], p[1], p[2], "fisheye", (k1, k2, 0.0, 0.0))
        case "OPENCV_FISHEYE":
            return Lens(width, height, p[0], p[1], p[2], p[3], "fisheye", tuple(p[4:]))
    raise HyrfDataError(f"camera model {model} is not supported", fix="undistort the photos with COLMAP first")


def _read_model(model: Path) -> tuple[dict[int, Lens], list[_Image], int, np.ndarray, np.ndarray]:
    """Read lenses by camera id, the registered photos, the number of other photos, points and their colours."""
    kind = _model_kind(model)
    if kind == ".bin":
        check_binary_model(model)
    pycolmap = load_pycolmap(f"{model}: reading COLMAP models")
    names = read_image_names(model / "images.txt") if kind == ".txt" else {}
    try:
        with readable_model(model, kind) as folder:
            reconstruction = pycolmap.Reconstruction(str(folder))
        images = reconstruction.images
        ids = np.array(sorted(reconstruction.points3D), np.uint64)
        posed = [
            _Image(names[key] if key in names else image.name, image.camera_id, _pose(image), _visible_rows(image, ids))
            for key, image in images.items()
            if image.has_pose
        ]
        cameras = {
            key: lens_from_colmap(camera.model.name, camera.width, camera.height, camera.params)
            for key, camera in reconstruction.cameras.items()
        }
        table = [point for _, point in sorted(reconstruction.points3D.items())]
        points = np.array([point.xyz for point in table]).reshape(-1, 3)
        colors = np.array([point.color for point in table], np.float32).reshape(-1, 3) / 255
    except HyrfDataError as error:
        raise error.with_text(f"{model}: {error.problem}") from error
    except Exception as error:  # pycolmap passes on C++ exceptions of many types
        raise HyrfDataError(
            f"{model}: the model's tables do not fit together ({short_reason(error, 160)})",
            fix="export it again",
        ) from error
    if kind == ".txt":
        for name, count in zip(COLMAP_TABLES, (len(cameras), len(images), len(points)), strict=True):
            _check_text_count(model / f"{name}.txt", count)
    if not len(points) and (model / "points3D.ply").is_file():
        points, colors = read_ply_points(model / "points3D.ply")
        posed = [image._replace(visible_points=None) for image in posed]
    unknown = next((image.name for image in posed if image.camera not in cameras), None)
    if unknown is not None:
        raise HyrfDataError(f"{model}: photo {unknown} has a camera that the model lacks", fix="export the model again")
    return cameras, posed, len(images) - len(posed), points, colors


def _model_kind(model: Path) -> str:
    """Return the extension of a model's tables.

    The table of points may be missing, because some programs write points as PLY or leave them out.
    """

    def missing(kind: str) -> list[str]:
        return [f"{table}{kind}" for table in COLMAP_TABLES[:2] if not (model / f"{table}{kind}").is_file()]

    for kind in (".bin", ".txt"):
        if not missing(kind):
            return kind
    kind = ".bin" if any((model / f"{table}.bin").is_file() for table in COLMAP_TABLES) else ".txt"
    raise HyrfDataError(f"{model / missing(kind)[0]}: the file is missing", fix="export the whole COLMAP model again")


def _visible_rows(image, ids: np.ndarray) -> np.ndarray:
    """Return the rows of a photo's points among the ascending ids of all points."""
    visible_ids = np.array([point.point3D_id for point in image.get_observation_points2D()], np.uint64)
    return np.searchsorted(ids, visible_ids[np.isin(visible_ids, ids)]).astype(np.int64)


def _pose(image) -> np.ndarray:
    """Return the (4, 4) camera_from_world of a pycolmap image, whose quaternion may be zero."""
    pose = np.eye(4)
    if not image.cam_from_world().rotation.quat.any():
        raise HyrfDataError(
            f"photo {image.name} has no rotation (its quaternion is zero)",
            fix="remove the photo from the model, or export the model again",
        )
    pose[:3] = image.cam_from_world().matrix()
    return pose


def _stated_count(file: Path) -> int | None:
    """Read the number of entries that a text table states in a comment, None if it states none."""
    with file.open(encoding="utf-8", errors="replace") as lines:
        comments = "".join(
            line for line, _ in zip(lines, range(8), strict=False) if line.lstrip("\ufeff").startswith("#")
        )
    stated = re.search(r"Number of \w+: (\d{1,18})", comments)
    return int(stated[1]) if stated else None


def _check_text_count(file: Path, count: int) -> None:
    """Check that a text table has as many entries as it states; otherwise lost lines would go unnoticed."""
    stated = _stated_count(file) if file.is_file() else None
    if stated is not None and stated != count:
        raise HyrfDataError(
            f"{file}: says {stated} entries but holds {count}",
            fix="the file is truncated, export it again",
        )

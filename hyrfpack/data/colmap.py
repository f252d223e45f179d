"""COLMAP reconstructions (`sparse/0` and the like with cameras, images, points3D as .bin or .txt), read by pycolmap."""

from __future__ import annotations

import math
import os
import re
from pathlib import Path, PurePosixPath

import numpy as np

from hyrfpack.data.assemble import Photo, check_found, make_scene, safe_name
from hyrfpack.data.colmap_binary import check_binary_model
from hyrfpack.data.pictures import find_mask, find_picture, mask_folder, read_header
from hyrfpack.data.undistort import Lens, brown
from hyrfpack.errors import HyrfDataError, needs_package
from hyrfpack.scene import Scene

_MODEL_FOLDERS = ("sparse", "colmap/sparse")
_TABLES = ("cameras", "images", "points3D")


def find_models(path: Path) -> list[Path]:
    """The folders below `path` that hold a COLMAP model (any of its files): those in `sparse/` by number, then by name,
    then `sparse/` itself; or the same in `colmap/sparse/`."""

    def holds_model(folder: Path) -> bool:
        return any(os.path.isfile(folder / f"{table}{kind}") for table in _TABLES for kind in (".bin", ".txt"))

    for parent in (path / name for name in _MODEL_FOLDERS):
        inside = [entry for entry in parent.iterdir() if entry.is_dir()] if os.path.isdir(parent) else []
        inside.sort(key=lambda entry: (int(entry.name) if entry.name.isdecimal() else math.inf, entry.name))
        models = [folder for folder in (*inside, parent) if holds_model(folder)]
        if models:
            return models
    return []


def read_colmap(path: Path, *, test_every: int, images: str | None, model: str | None, max_size: int) -> Scene:
    """Read a folder with a COLMAP model and its photos.

    Args:
        path: the scene folder.
        test_every, max_size: see `load_scene`.
        images: the folder of photos; "images" when None. Intrinsics follow the size of the files in it.
        model: name of the folder of the model; None takes the one with the most photos.

    Returns:
        The scene, in the frame and units of the model.

    Raises:
        HyrfDataError: the model or the photos cannot be used.
    """
    tables, notes = _choose_model(path, model)
    picture_folder = path / (images or "images")
    if not picture_folder.is_dir():
        there = ", ".join(sorted(entry.name for entry in path.iterdir() if entry.is_dir()))
        raise HyrfDataError(f"{path}: no photo folder '{picture_folder.name}'; there are the folders {there}")

    cameras, posed, unposed, points, colors = _read_model(tables)
    if unposed:
        notes.append(f"{unposed} photos were never registered and were skipped")
    masks = mask_folder(path, picture_folder.name)
    photos: list[Photo] = []
    missing: list[str] = []
    for name, camera_id, pose in posed:
        name = safe_name(name)
        file = find_picture(picture_folder / name)
        if file is None:
            missing.append(str(PurePosixPath(images or "images") / name))
            continue
        mask = find_mask(masks, name)
        photos.append(Photo(name, file, read_header(file), cameras[camera_id], pose, mask))
    notes += check_found(path, photos, missing, str(tables.relative_to(path)))
    return make_scene(
        path,
        "colmap",
        photos,
        test_every=test_every,
        max_size=max_size,
        points=points,
        point_colors=colors,
        tables=sorted(file for file in tables.iterdir() if file.is_file()),
        masks=masks,
        notes=notes,
    )


def _choose_model(path: Path, name: str | None) -> tuple[Path, list[str]]:
    """The model of a name, or the one with the most photos, and a note where there was a choice."""
    models = find_models(path)
    if not models:
        raise HyrfDataError(f"{path}: no COLMAP model in {' or '.join(_MODEL_FOLDERS)}; run the reconstruction first")
    if name is None and len(models) == 1:
        return models[0], []
    sizes = {model.name: _registered(model) for model in models}
    there = ", ".join(f"{model} ({size} photos)" for model, size in sizes.items())
    chosen = max(models, key=lambda model: sizes[model.name])  # the first of the largest
    why = "with the most photos; --model takes another"
    if name is not None:
        if name not in sizes:
            raise HyrfDataError(f"{path}: there is no COLMAP model '{name}'; name one of those that are there: {there}")
        chosen, why = next(model for model in models if model.name == name), "as asked for"
    return chosen, [f"there are {len(models)} COLMAP models: {there}; {chosen.name} was taken, {why}"]


def _registered(model: Path) -> int:
    """How many photos a model says that it has posed; 0 where it does not, which reading it finds the reason for."""
    try:
        if (model / "images.bin").is_file():
            with (model / "images.bin").open("rb") as table:
                return int.from_bytes(table.read(8), "little")
        stated = _stated_count(model / "images.txt")
        if stated is not None:
            return stated
        with (model / "images.txt").open(encoding="utf-8", errors="replace") as lines:
            return (sum(not line.startswith("#") for line in lines) + 1) // 2  # two lines a photo
    except OSError:
        return 0


def lens_from_colmap(model: str, width: int, height: int, params: np.ndarray) -> Lens:
    """Translate a COLMAP camera.

    Args:
        model: COLMAP's name of the camera model.
        width, height: pixels.
        params: in COLMAP's order for that model.

    Raises:
        HyrfDataError: a model that is no perspective or fisheye polynomial.
    """
    p = [float(value) for value in params]
    match model:
        case "SIMPLE_PINHOLE":
            return Lens(width, height, p[0], p[0], p[1], p[2])
        case "PINHOLE":
            return Lens(width, height, p[0], p[1], p[2], p[3])
        case "SIMPLE_RADIAL" | "RADIAL":
            return Lens(width, height, p[0], p[0], p[1], p[2], "brown", brown(*p[3:]))
        case "OPENCV" | "FULL_OPENCV":
            return Lens(width, height, p[0], p[1], p[2], p[3], "brown", brown(*p[4:]))
        case "SIMPLE_RADIAL_FISHEYE" | "RADIAL_FISHEYE":
            k1, k2 = (*p[3:], 0.0)[:2]
            return Lens(width, height, p[0], p[0], p[1], p[2], "fisheye", (k1, k2, 0.0, 0.0))
        case "OPENCV_FISHEYE":
            return Lens(width, height, p[0], p[1], p[2], p[3], "fisheye", tuple(p[4:]))
    raise HyrfDataError(f"camera model {model} is not supported; undistort the photos with COLMAP first")


def _read_model(model: Path) -> tuple[dict[int, Lens], list, int, np.ndarray, np.ndarray]:
    """Cameras by id, (name, camera id, (4, 4) pose) of the registered photos, the count of the others, points and
    their colours."""
    kind = _model_kind(model)
    if kind == ".bin":
        check_binary_model(model)
    with needs_package("pycolmap", f"{model}: reading COLMAP models"):
        import pycolmap
    try:
        reconstruction = pycolmap.Reconstruction(str(model))
        images = list(reconstruction.images.values())
        posed = [(image.name, image.camera_id, _pose(image)) for image in images if image.has_pose]
        cameras = {
            key: lens_from_colmap(camera.model.name, camera.width, camera.height, camera.params)
            for key, camera in reconstruction.cameras.items()
        }
        table = [point for _, point in sorted(reconstruction.points3D.items())]
        points = np.array([point.xyz for point in table]).reshape(-1, 3)
        colors = np.array([point.color for point in table], np.float32).reshape(-1, 3)
    except HyrfDataError as error:
        raise HyrfDataError(f"{model}: {error}") from error
    except Exception as error:  # pycolmap hands on whatever its C++ checks throw.
        reason = str(error).splitlines()[0][:160] if str(error) else type(error).__name__
        raise HyrfDataError(f"{model}: the model's tables do not fit together ({reason}); export it again") from error
    if kind == ".txt":
        for name, count in zip(_TABLES, (len(cameras), len(images), len(points)), strict=True):
            _check_text_count(model / f"{name}.txt", count)
    unknown = next((name for name, camera_id, _ in posed if camera_id not in cameras), None)
    if unknown is not None:
        raise HyrfDataError(f"{model}: photo {unknown} has a camera that the model lacks; export the model again")
    return cameras, posed, len(images) - len(posed), points, colors / 255


def _model_kind(model: Path) -> str:
    kind = ".bin" if any((model / f"{table}.bin").is_file() for table in _TABLES) else ".txt"
    for table in _TABLES:
        if not (model / f"{table}{kind}").is_file():
            raise HyrfDataError(f"{model / (table + kind)}: missing; export the whole COLMAP model again")
    return kind


def _pose(image) -> np.ndarray:
    pose = np.eye(4)
    pose[:3] = image.cam_from_world().matrix()
    return pose


def _stated_count(file: Path) -> int | None:
    """The number of entries that a text table states in a comment, None where it does not."""
    with file.open(encoding="utf-8", errors="replace") as lines:
        comments = "".join(line for line, _ in zip(lines, range(8), strict=False) if line.startswith("#"))
    stated = re.search(r"Number of \w+: (\d{1,18})", comments)
    return int(stated[1]) if stated else None


def _check_text_count(file: Path, count: int) -> None:
    """The stated count is the one way to notice that lines are lost."""
    stated = _stated_count(file)
    if stated is not None and stated != count:
        raise HyrfDataError(f"{file}: says {stated} entries but holds {count}; the file is truncated, export it again")

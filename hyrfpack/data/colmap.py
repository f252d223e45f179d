"""COLMAP reconstructions (`sparse/0` with cameras, images, points3D as .bin or .txt), read by pycolmap."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from hyrfpack.data.assemble import Photo, make_scene, safe_name, skipped_note
from hyrfpack.data.colmap_binary import check_binary_model
from hyrfpack.data.pictures import find_mask, find_picture, read_header
from hyrfpack.data.undistort import Lens, brown
from hyrfpack.errors import HyrfDataError, needs_package
from hyrfpack.scene import Scene

_MODEL_FOLDERS = ("sparse/0", "sparse", "colmap/sparse/0")
_TABLES = ("cameras", "images", "points3D")


def find_model(path: Path) -> Path | None:
    """The folder below `path` that holds a COLMAP model (any of its files), or None."""
    for folder in _MODEL_FOLDERS:
        if any((path / folder / f"{table}{kind}").is_file() for table in _TABLES for kind in (".bin", ".txt")):
            return path / folder
    return None


def read_colmap(path: Path, *, test_every: int, images: str | None, max_size: int) -> Scene:
    """Read a folder with a COLMAP model and its photos.

    Args:
        path: the scene folder.
        test_every, max_size: see `load_scene`.
        images: the folder of photos; "images" when None. Intrinsics follow the size of the files in it.

    Returns:
        The scene, in the frame and units of the model.

    Raises:
        HyrfDataError: the model or the photos cannot be used.
    """
    model = find_model(path)
    if model is None:
        raise HyrfDataError(f"{path}: no COLMAP model in {', '.join(_MODEL_FOLDERS)}; run the reconstruction first")
    picture_folder = path / (images or "images")
    if not picture_folder.is_dir():
        there = ", ".join(sorted(entry.name for entry in path.iterdir() if entry.is_dir()))
        raise HyrfDataError(f"{path}: no photo folder '{picture_folder.name}'; there are the folders {there}")

    cameras, posed, unposed, points, colors = _read_model(model)
    notes = []
    siblings = [entry.name for entry in model.parent.iterdir() if entry.is_dir() and entry.name.isdigit()]
    if model.name == "0" and len(siblings) > 1:
        notes.append(f"{model.parent} holds {len(siblings)} models; only '0' was read")
    if unposed:
        notes.append(f"{unposed} photos were never registered and were skipped")
    photos, missing = [], 0
    for name, camera_id, pose in posed:
        name = safe_name(name)
        file = find_picture(picture_folder / name)
        if file is None:
            missing += 1
            continue
        mask = find_mask(path, picture_folder.name, name)
        photos.append(Photo(name, file, read_header(file), cameras[camera_id], pose, mask))
    notes += skipped_note(missing, len(posed), str(model))
    return make_scene(
        path,
        "colmap",
        photos,
        test_every=test_every,
        max_size=max_size,
        points=points,
        point_colors=colors,
        tables=sorted(file for file in model.iterdir() if file.is_file()),
        notes=notes,
    )


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
            return Lens(width, height, *p)
        case "SIMPLE_RADIAL" | "RADIAL":
            return Lens(width, height, p[0], p[0], p[1], p[2], "brown", brown(*p[3:]))
        case "OPENCV" | "FULL_OPENCV":
            return Lens(width, height, *p[:4], "brown", brown(*p[4:]))
        case "SIMPLE_RADIAL_FISHEYE" | "RADIAL_FISHEYE":
            k1, k2 = (*p[3:], 0.0)[:2]
            return Lens(width, height, p[0], p[0], p[1], p[2], "fisheye", (k1, k2, 0.0, 0.0))
        case "OPENCV_FISHEYE":
            return Lens(width, height, *p[:4], "fisheye", tuple(p[4:]))
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
        for table, count in zip(_TABLES, (len(cameras), len(images), len(points)), strict=True):
            _check_text_count(model / f"{table}.txt", count)
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


def _check_text_count(file: Path, count: int) -> None:
    """Text tables state their length in a comment: the one way to notice that lines are lost."""
    with file.open(encoding="utf-8", errors="replace") as lines:
        comments = "".join(line for line, _ in zip(lines, range(8), strict=False) if line.startswith("#"))
    stated = re.search(r"Number of \w+: (\d{1,18})", comments)
    if stated and int(stated[1]) != count:
        raise HyrfDataError(
            f"{file}: says {stated[1]} entries but holds {count}; the file is truncated, export it again"
        )

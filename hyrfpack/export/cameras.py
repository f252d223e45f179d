"""Export of a scene's cameras for other trainers: as a COLMAP model or as nerfstudio's transforms.json."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hyrfpack.cameras.view_sampling import fit_camera
from hyrfpack.colmap_library import load_pycolmap
from hyrfpack.data.archive import display_path
from hyrfpack.data.pictures import PhotoFile
from hyrfpack.outputs.indexed_folder import IndexedFolder
from hyrfpack.scene import Camera, View, evenly_spaced
from hyrfpack.splats.splats import Splats

COLMAP_FILES = tuple(f"sparse/0/{table}.bin" for table in ("cameras", "frames", "images", "points3D", "rigs"))
_CAMERAS_TABLE = "cameras.bin"  # without which no program reads the others
MAX_COLMAP_POINTS = 100_000  # the size of a large reconstruction
_MIN_POINT_OPACITY = 0.1  # because the centres of fainter Gaussians need not lie on a surface


def fit_to_file(view: View) -> Camera:
    """Return the camera of a photo as it is stored, which may be larger than as it is loaded.

    The camera of a view whose file is unknown stays as it is.
    """
    camera = view.camera
    if not isinstance(view.load, PhotoFile) or view.load.stored == (camera.width, camera.height):
        return camera
    return fit_camera(camera, *view.load.stored)


def locate_photo(view: View, folder: str | os.PathLike[str]) -> str:
    """Return the path of a photo relative to a folder; "images/NAME" if its file is unknown or inside an archive."""
    if not isinstance(view.load, PhotoFile) or display_path(view.load.path) != view.load.path:
        return f"images/{view.name}"
    photo, start = Path(os.path.abspath(view.load.path)), Path(os.path.abspath(folder))
    if photo.is_relative_to(start):
        return photo.relative_to(start).as_posix()
    try:  # ".." leads out of the folder that a link points to, so links are resolved
        return Path(os.path.relpath(photo.parent.resolve() / photo.name, start.resolve())).as_posix()
    except ValueError:  # on Windows, no relative path leads to another drive
        return photo.as_posix()


def write_colmap(
    cameras: Sequence[tuple[str, Camera]],
    folder: str | os.PathLike[str],
    points: Splats | None,
    *,
    overwrite: bool = True,
) -> int:
    """Write a binary COLMAP model to `folder`/sparse/0, and return its size in bytes.

    The photo folder belongs at `folder`/images.

    The model has one PINHOLE camera for each distinct size and intrinsics, and one image without observations for each
    photo, all numbered from 1 in order. The points, from which a trainer can start, are evenly picked centres of
    Gaussians that are not faint; they have no tracks. Existing tables are replaced only when all new ones are written.

    Args:
        cameras: names of the photos, relative to the photo folder, with their cameras.
        folder: output folder; created if it is missing.
        points: splats whose centres become points, or None for no points.
        overwrite: replace existing tables.

    Raises:
        HyrfError: pycolmap is missing, a file cannot be written, or a table exists and `overwrite` is False.
    """
    pycolmap = load_pycolmap(f"{folder}: writing a COLMAP model")
    model = pycolmap.Reconstruction()
    numbers: dict[tuple[float, ...], int] = {}
    for image_id, (name, camera) in enumerate(cameras, start=1):
        lens = (camera.width, camera.height, *camera.intrinsics)
        if lens not in numbers:
            numbers[lens] = len(numbers) + 1
            size = {"width": camera.width, "height": camera.height}
            model.add_camera_with_trivial_rig(
                pycolmap.Camera(model="PINHOLE", params=camera.intrinsics, camera_id=numbers[lens], **size)
            )
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(camera.rotation), camera.camera_from_world[:3, 3])
        model.add_image_with_trivial_frame(pycolmap.Image(name=name, image_id=image_id, camera_id=numbers[lens]), pose)
    if points is not None:
        solid = np.flatnonzero(points.opacities >= _MIN_POINT_OPACITY)
        chosen = points[np.array(evenly_spaced(solid.tolist(), MAX_COLMAP_POINTS), np.int64)]
        colors = np.round(255 * chosen.base_colors).astype(np.uint8)
        for position, color in zip(chosen.positions, colors, strict=True):
            model.add_point3D(position, pycolmap.Track(), color)

    tables = IndexedFolder(Path(folder, "sparse", "0"), _CAMERAS_TABLE, overwrite)
    with tempfile.TemporaryDirectory() as temporary, tables:
        model.write_binary(temporary)
        for table in sorted(Path(temporary).iterdir(), key=lambda table: (table.name == _CAMERAS_TABLE, table.name)):
            tables.write(table.name, table.read_bytes())
    return tables.bytes


def encode_transforms(cameras: Sequence[tuple[str, Camera]]) -> bytes:
    """Encode cameras as a transforms.json.

    Matrices are world_from_camera for OpenGL cameras (x right, y up, z backward), in the input's axes and units.
    Intrinsics are written once if all frames share them, otherwise for each frame.

    Args:
        cameras: paths of the photos, relative to the folder of the transforms.json, with their cameras.
    """
    lenses = [
        {"w": c.width, "h": c.height, **dict(zip(("fl_x", "fl_y", "cx", "cy"), c.intrinsics, strict=True))}
        for _, c in cameras
    ]
    shared = lenses[0] if lenses and all(lens == lenses[0] for lens in lenses) else {}
    frames = []
    for (path, camera), lens in zip(cameras, lenses, strict=True):
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = camera.rotation.T * (1, -1, -1), camera.position
        frames.append({"file_path": path, **({} if shared else lens), "transform_matrix": matrix.tolist()})
    content = {"camera_model": "PINHOLE", **shared, "frames": frames}
    return (json.dumps(content, indent=1) + "\n").encode()

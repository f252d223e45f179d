"""The cameras of a scene in the layouts that other trainers read: a COLMAP model, and nerfstudio's transforms.json."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from hyrfpack.atomic import pending_file
from hyrfpack.errors import needs_package
from hyrfpack.scene import Camera, evenly_spaced
from hyrfpack.splats.splats import Splats

COLMAP_FILES = tuple(f"sparse/0/{table}.bin" for table in ("cameras", "frames", "images", "points3D", "rigs"))
MAX_POINTS = 100_000  # in a COLMAP model: as many as a large reconstruction has
_MIN_OPACITY = 0.1  # of a Gaussian whose centre is a point: fainter ones lie anywhere


def write_colmap(
    cameras: Sequence[tuple[str, Camera]],
    folder: str | os.PathLike[str],
    points: Splats | None,
    max_points: int = MAX_POINTS,
    *,
    overwrite: bool = True,
) -> None:
    """Write `folder`/sparse/0, a binary COLMAP model. The photos belong into `folder`/images.

    One PINHOLE camera for each distinct size and intrinsics, one image for each photo, without observations, all
    numbered from 1 in order. Points are centres of Gaussians that are not faint, evenly picked, without tracks:
    something for a trainer to start from. No table is replaced before all are written.

    Args:
        cameras: photo names, below the photo folder, and their cameras.
        folder: where; made when it is missing.
        points: whose centres become points, or None for no points.
        max_points: at most so many points.
        overwrite: replace tables that are there.

    Raises:
        HyrfError: pycolmap is missing, or a file cannot be written, or not without `overwrite`.
    """
    with needs_package("pycolmap", f"{folder}: writing a COLMAP model"):
        import pycolmap

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
        solid = np.flatnonzero(points.opacities >= _MIN_OPACITY)
        chosen = points[np.array(evenly_spaced(solid.tolist(), max_points), np.int64)]
        colors = np.round(255 * chosen.base_colors).astype(np.uint8)
        for position, color in zip(chosen.positions, colors, strict=True):
            model.add_point3D(position, pycolmap.Track(), color)

    target = Path(folder, "sparse", "0")
    with tempfile.TemporaryDirectory() as temporary, ExitStack() as tables:
        model.write_binary(temporary)
        for table in sorted(Path(temporary).iterdir()):
            data = table.read_bytes()
            # They take their names when the block ends.
            pending = pending_file(target / table.name, len(data), overwrite=overwrite, rename=False)
            tables.enter_context(pending).temporary.write_bytes(data)


def encode_transforms(cameras: Sequence[tuple[str, Camera]]) -> bytes:
    """Cameras as a transforms.json, which lies beside the photo folder "images".

    Matrices are world_from_camera of OpenGL's cameras (x right, y up, z backward), in the input's axes and units.
    Intrinsics stand once for all frames where they are the same, otherwise with each.

    Args:
        cameras: photo names, below the photo folder, and their cameras.
    """
    lenses = [
        {"w": c.width, "h": c.height, **dict(zip(("fl_x", "fl_y", "cx", "cy"), c.intrinsics, strict=True))}
        for _, c in cameras
    ]
    shared = lenses[0] if lenses and all(lens == lenses[0] for lens in lenses) else {}
    frames = []
    for (name, camera), lens in zip(cameras, lenses, strict=True):
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = camera.rotation.T * (1, -1, -1), camera.position
        frames.append({"file_path": f"images/{name}", **({} if shared else lens), "transform_matrix": matrix.tolist()})
    content = {"camera_model": "PINHOLE", **shared, "frames": frames}
    return (json.dumps(content, indent=1) + "\n").encode()

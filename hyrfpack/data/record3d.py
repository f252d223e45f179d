"""Read Record3D's recordings: metadata beside a folder of frames, as in a .r3d archive or an "EXR + JPG" export.

`metadata` is JSON: `w` and `h`, `K` in column-major order, and `poses` as qx qy qz qw px py pz, one for each frame. It
often has `perFrameIntrinsicCoeffs` as fx fy cx cy. A pose is world_from_camera with OpenGL's axes (x right, y up, z
backward) for the picture as stored. Frames are numbered from 0. Depth maps are not read.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from hyrfpack.data.assemble import assemble_scene
from hyrfpack.data.sidecar_files import PoseEntry, find_listed_photos
from hyrfpack.data.transforms import finite_number, pose_from_camera_axes, read_json_object
from hyrfpack.data.undistort import Lens
from hyrfpack.errors import HyrfDataError
from hyrfpack.scene import Scene

_METADATA_AND_FRAMES = (("metadata", "rgbd"), ("metadata.json", "rgb"), ("EXR_RGBD/metadata.json", "EXR_RGBD/rgb"))


def find_record3d(path: Path) -> tuple[Path, Path] | None:
    """Find the metadata and the folder of frames of a recording, None if the folder holds none."""
    for table, frames in _METADATA_AND_FRAMES:
        if os.path.isfile(path / table) and os.path.isdir(path / frames):
            return path / table, path / frames
    return None


def read_record3d(path: Path, *, test_every: int, max_size: int) -> Scene:
    """Read a recording. The world is in metres, and there are no points.

    Args:
        path: the folder that contains the metadata.
        test_every, max_size: see `load_scene`.

    Raises:
        HyrfDataError: the metadata or the frames cannot be used.
    """
    recording = find_record3d(path)
    if recording is None:
        raise HyrfDataError(
            f"{path}: no metadata beside a folder of frames (rgbd or rgb)",
            fix="unpack the recording again",
        )
    table, folder = recording
    content = read_json_object(table)
    width, height = (round(finite_number(content, key, table) or 0) for key in ("w", "h"))
    poses = _array(content.get("poses"), 7)
    if poses is None:
        raise HyrfDataError(f"{table}: has no list of 'poses' of 7 numbers", fix="record again, with the LiDAR camera")
    lenses = _array(content.get("perFrameIntrinsicCoeffs"), 4)
    if lenses is None or len(lenses) != len(poses):
        matrix = _array([content.get("K")], 9)
        if matrix is None:
            raise HyrfDataError(
                f"{table}: has neither 'K' nor 'perFrameIntrinsicCoeffs' for each pose",
                fix="export it again",
            )
        lenses = np.repeat(matrix[:, [0, 4, 6, 7]], len(poses), axis=0)
    entries: list[PoseEntry] = []
    for frame, (pose, intrinsics) in enumerate(zip(poses, lenses, strict=True)):
        fx, fy, cx, cy = map(float, intrinsics)
        lens = Lens(width, height, fx, fy, cx, cy)
        axes = _rotation(pose[:4]) * (1, -1, -1)
        entries.append((f"{frame}.jpg", lens, pose_from_camera_axes(axes, pose[4:])))
    photos, masks, notes = find_listed_photos(path, folder, entries, table.name)
    return assemble_scene(
        path,
        "record3d",
        photos,
        test_every=test_every,
        max_size=max_size,
        tables=[table],
        masks=masks,
        notes=notes,
    )


def _array(values: object, columns: int) -> np.ndarray | None:
    """Convert values to (N, columns) finite float64, N >= 1; return None if that is not possible."""
    try:
        array = np.array(values, np.float64)
    except (TypeError, ValueError, OverflowError, RecursionError):
        return None
    usable = array.ndim == 2 and array.shape[1] == columns and len(array) > 0 and np.isfinite(array).all()
    return array if usable else None


def _rotation(quaternion: np.ndarray) -> np.ndarray:
    """Return the (3, 3) rotation of an xyzw quaternion of any length; it is not finite if the length is 0."""
    with np.errstate(all="ignore"):
        x, y, z, w = quaternion / np.linalg.norm(quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )

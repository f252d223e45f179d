"""Record3D's recordings: metadata beside a folder of frames, as in a .r3d archive or an "EXR + JPG" export.

`metadata` is JSON: `w` and `h`, `K` column by column, `poses` as qx qy qz qw px py pz, one for each frame, and often
`perFrameIntrinsicCoeffs` as fx fy cx cy. A pose is world_from_camera with OpenGL's axes (x right, y up, z backward) for
the picture as it is stored. Frames are numbered from 0. Depth maps are not read.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from hyrfpack.data.assemble import make_scene
from hyrfpack.data.beside import Entry, photos_beside
from hyrfpack.data.transforms import inverted, number, read_object
from hyrfpack.data.undistort import Lens
from hyrfpack.errors import HyrfDataError
from hyrfpack.scene import Scene

_PLACES = (("metadata", "rgbd"), ("metadata.json", "rgb"), ("EXR_RGBD/metadata.json", "EXR_RGBD/rgb"))


def find_record3d(path: Path) -> tuple[Path, Path] | None:
    """The metadata and the folder of frames of a recording, if a folder holds one."""
    for table, frames in _PLACES:
        if os.path.isfile(path / table) and os.path.isdir(path / frames):
            return path / table, path / frames
    return None


def read_record3d(path: Path, *, test_every: int, max_size: int) -> Scene:
    """Read a recording, in metres; there are no points.

    Args:
        path: the folder that the metadata are in.
        test_every, max_size: see `load_scene`.

    Raises:
        HyrfDataError: the metadata or the frames cannot be used.
    """
    place = find_record3d(path)
    if place is None:
        raise HyrfDataError(f"{path}: no metadata beside a folder of frames (rgbd or rgb); unpack the recording again")
    table, folder = place
    content = read_object(table)
    width, height = (round(number(content, key, table) or 0) for key in ("w", "h"))
    poses = _array(content.get("poses"), 7)
    if poses is None:
        raise HyrfDataError(f"{table}: has no list of 'poses' of 7 numbers; record again, with the LiDAR camera")
    lenses = _array(content.get("perFrameIntrinsicCoeffs"), 4)
    if lenses is None or len(lenses) != len(poses):
        matrix = _array([content.get("K")], 9)
        if matrix is None:
            raise HyrfDataError(
                f"{table}: has neither 'K' nor 'perFrameIntrinsicCoeffs' for each pose; export it again"
            )
        lenses = np.repeat(matrix[:, [0, 4, 6, 7]], len(poses), axis=0)
    entries: list[Entry] = []
    for frame, (pose, intrinsics) in enumerate(zip(poses, lenses, strict=True)):
        fx, fy, cx, cy = map(float, intrinsics)
        lens = Lens(width, height, fx, fy, cx, cy)
        axes = _rotation(pose[:4]) * (1, -1, -1)
        entries.append((f"{frame}.jpg", lens, inverted(axes, pose[4:])))
    photos, masks, notes = photos_beside(path, folder, entries, table.name)
    return make_scene(
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
    """(N, columns) finite float64, N >= 1, or None where `values` are anything else."""
    try:
        array = np.array(values, np.float64)
    except (TypeError, ValueError, OverflowError, RecursionError):
        return None
    usable = array.ndim == 2 and array.shape[1] == columns and len(array) > 0 and np.isfinite(array).all()
    return array if usable else None


def _rotation(quaternion: np.ndarray) -> np.ndarray:
    """(3, 3) of a quaternion xyzw of any length but 0, whose rotation is not finite."""
    with np.errstate(all="ignore"):
        x, y, z, w = quaternion / np.linalg.norm(quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )

"""Read LLFF datasets: poses_bounds.npy beside folders of photos.

Each row has 17 numbers: a 3 x 5 matrix, row by row, and the nearest and the farthest depth. The first three columns are
the camera's axes down, right and backwards in the world, and the fourth is its position. The fifth is the picture's
height, width and focal length, in pixels of the photos whose poses were estimated. Rows are sorted by the photos'
names.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from hyrfpack.data.assemble import assemble_scene
from hyrfpack.data.pictures import is_picture_name
from hyrfpack.data.sidecar_files import PoseEntry, find_listed_photos, find_picture_folder
from hyrfpack.data.transforms import pose_from_camera_axes
from hyrfpack.data.undistort import Lens
from hyrfpack.errors import HyrfDataError, short_reason
from hyrfpack.scene import Scene

POSES_FILE = "poses_bounds.npy"


def read_llff(path: Path, *, test_every: int, images: str | None, max_size: int) -> Scene:
    """Read a folder with a poses_bounds.npy, which contains no points.

    Args:
        path: the scene folder.
        test_every, max_size: see `load_scene`.
        images: the folder of photos; None takes the one that `find_picture_folder` finds.

    Raises:
        HyrfDataError: the table or the photos cannot be used, or they differ in number.
    """
    rows = _read_table(path / POSES_FILE)
    folder, notes = find_picture_folder(path, images), []
    if images is None and folder.name != "images":
        notes.append(f"photos are read from {folder.name}")
    try:
        names = sorted(entry.name for entry in os.scandir(folder) if is_picture_name(entry.name) and entry.is_file())
    except OSError as error:
        raise HyrfDataError(
            f"{folder}: the folder cannot be read ({error.strerror})",
            fix="check its permissions",
        ) from error
    if len(names) != len(rows):
        raise HyrfDataError(
            f"{path / POSES_FILE}: holds the poses of {len(rows)} photos, but {folder.name} holds {len(names)}, and "
            "photos are matched by their order",
            fix="keep only the photos with poses in that folder",
        )
    entries: list[PoseEntry] = []
    for name, row in zip(names, rows, strict=True):
        matrix = row[:15].reshape(3, 5)
        height, width, focal = matrix[:, 4]
        down, right, back = matrix[:, :3].T
        lens = Lens(round(width), round(height), focal, focal, width / 2, height / 2)
        entries.append((name, lens, pose_from_camera_axes(np.stack((right, down, -back), 1), matrix[:, 3])))
    photos, masks, found = find_listed_photos(path, folder, entries, POSES_FILE)
    return assemble_scene(
        path,
        "llff",
        photos,
        test_every=test_every,
        max_size=max_size,
        tables=[path / POSES_FILE],
        masks=masks,
        notes=notes + found,
    )


def _read_table(file: Path) -> np.ndarray:
    """Read and check the (N, 17) float64 table: N >= 1, finite poses, and sizes of at least a pixel."""
    try:
        # The file is mapped, so that a forged shape allocates no memory. Pickles are not allowed.
        table = np.load(file, mmap_mode="r", allow_pickle=False)
    except Exception as error:  # a damaged header makes numpy raise exceptions of many types
        raise HyrfDataError(
            f"{file}: not a table that can be read ({short_reason(error)})",
            fix="restore the file",
        ) from error
    if not isinstance(table, np.ndarray) or table.ndim != 2 or table.shape[1] != 17 or table.dtype.kind not in "fiu":
        raise HyrfDataError(
            f"{file}: not a table of 17 numbers for each photo, as LLFF writes it",
            fix="restore the file",
        )
    rows = np.array(table, np.float64)
    sizes = rows[:, [4, 9]]
    if not len(rows) or not np.isfinite(rows[:, :15]).all() or not ((sizes >= 0.5) & (sizes < 1e6)).all():
        raise HyrfDataError(
            f"{file}: the table is empty, or a pose or a size in it is not finite",
            fix="estimate the poses again",
        )
    return rows

"""Points with colours out of PLY files, as photogrammetry writes them beside its poses."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from hyrfpack.errors import HyrfDataError, needs_package, reason_of


def read_ply(ply: Path) -> tuple[np.ndarray, np.ndarray]:
    """(P, 3) positions and (P, 3) RGB in [0, 1], grey where the file has no colours.

    Raises:
        HyrfDataError: the file cannot be read, or holds fewer points than it says.
    """
    with needs_package("trimesh", f"{ply}: reading points"):
        import trimesh
    try:
        with ply.open("rb") as stream:
            stated = re.search(rb"element vertex (\d{1,18})\s", stream.read(4096))
        # A texture that the file names is of no use here, and would be opened.
        cloud = trimesh.load(str(ply), file_type="ply", process=False, skip_materials=True)
        points = np.asarray(getattr(cloud, "vertices", np.zeros((0, 3))), dtype=np.float64)
        mesh = isinstance(cloud, trimesh.Trimesh)
        rgba = np.asarray(cloud.visual.vertex_colors if mesh else getattr(cloud, "colors", ()))
        colors = rgba[:, :3] / 255 if rgba.shape == (len(points), 4) else np.full_like(points, 0.5)
    except Exception as error:  # trimesh raises whatever its parsing meets.
        raise HyrfDataError(f"{ply}: the points cannot be read ({reason_of(error)}); export them again") from error
    if points.ndim != 2 or points.shape[1:] != (3,) or colors.shape != points.shape:
        raise HyrfDataError(f"{ply}: the points have no usable positions and colours; export them again")
    if stated and int(stated[1]) != len(points):
        raise HyrfDataError(f"{ply}: says {int(stated[1])} points but holds {len(points)}; export them again")
    return points, colors

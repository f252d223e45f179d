"""COLMAP's text tables of cameras, photos and points."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from hyrfpack.scene import Camera
from tools.scenes.sparse import SparsePoints


def format_tables(cameras: Sequence[Camera], names: Sequence[str], points: SparsePoints) -> dict[str, bytes]:
    """Return the contents of cameras.txt, images.txt and points3D.txt; all photos share one camera."""
    return {
        "cameras.txt": _format_cameras(cameras[0]),
        "images.txt": _format_images(cameras, names, points),
        "points3D.txt": _format_points(points),
    }


def _format_cameras(camera: Camera) -> bytes:
    numbers = " ".join(repr(float(value)) for value in camera.intrinsics)
    return f"# Number of cameras: 1\n1 PINHOLE {camera.width} {camera.height} {numbers}\n".encode()


def _format_images(cameras: Sequence[Camera], names: Sequence[str], points: SparsePoints) -> bytes:
    lines = [f"# Number of images: {len(cameras)}"]
    for number, (camera, name) in enumerate(zip(cameras, names, strict=True)):
        x, y, z, w = Rotation.from_matrix(camera.rotation).as_quat()
        pose = " ".join(repr(float(value)) for value in (w, x, y, z, *camera.camera_from_world[:3, 3]))
        rows = points.photo == number
        places = [f"{x:.3f} {y:.3f} {n + 1}" for (x, y), n in zip(points.pixels[rows], points.point[rows], strict=True)]
        lines += [f"{number + 1} {pose} 1 {name}", " ".join(places)]
    return ("\n".join(lines) + "\n").encode()


def _format_points(points: SparsePoints) -> bytes:
    order = np.argsort(points.photo, kind="stable")  # the order of the observations in images.txt
    index = np.empty(len(order), np.int64)
    starts = np.searchsorted(points.photo[order], np.arange(points.photo.max(initial=0) + 1))
    index[order] = np.arange(len(order)) - starts[points.photo[order]]
    edges = np.searchsorted(points.point, np.arange(len(points.positions) + 1))
    lines = [f"# Number of points: {len(points.positions)}"]
    for n, (position, color, error) in enumerate(zip(points.positions, points.colors, points.errors, strict=True)):
        track = " ".join(f"{points.photo[m] + 1} {index[m]}" for m in range(edges[n], edges[n + 1]))
        place, rgb = " ".join(f"{value:.9g}" for value in position), " ".join(str(value) for value in color)
        lines.append(f"{n + 1} {place} {rgb} {error:.4f} {track}")
    return ("\n".join(lines) + "\n").encode()

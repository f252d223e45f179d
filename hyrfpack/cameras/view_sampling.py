"""Choose the small views in which a model is rendered for measurements: at its cameras and between them."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from hyrfpack.scene import Camera

MAX_SMALL_VIEW_SIDE_PIXELS = 512
# Interpolated views are wider than the photos by this factor, to include what lies just outside the photos.
INTERPOLATED_VIEW_SIZE_RATIO = 1.4
_NEIGHBOUR_CANDIDATES = 3
# Cost of a rotation in the search for neighbours, in median distances to the nearest camera.
_ROTATION_COST_PER_RADIAN = 10.0


def sample_views(cameras: Sequence[Camera], count: int, seed: int = 0) -> tuple[list[Camera], list[Camera]]:
    """Select at most `count` cameras that represent a capture, and interpolate one more view for each of them.

    The sequence of cameras is divided into `count` equal parts, and the middle camera of each part is selected. The
    first and the last camera are avoided: a path around the scene starts and ends there, so they represent few others.

    Returns:
        The selected cameras, and for each of them a view interpolated towards a neighbour, see `interpolate_views`.
    """
    count = min(count, len(cameras))
    indices = [(2 * part + 1) * len(cameras) // (2 * count) for part in range(count)]
    return [cameras[index] for index in indices], interpolate_views(cameras, seed, indices)


@dataclass(frozen=True)
class Windows:
    """Windows of pictures: each view shows one cell of a grid into which a whole picture is divided.

    Attributes:
        views: the windows.
        columns, rows: the grid; 1 and 1 for whole pictures.
    """

    views: list[Camera]
    columns: int
    rows: int

    @property
    def pictures(self) -> float:
        """Return the number of whole pictures that have as many pixels as all windows together."""
        return len(self.views) / (self.columns * self.rows)


def sample_windows(cameras: Sequence[Camera], count: int, cells: int, seed: int = 0) -> Windows:
    """Select about `count` views, in turn at cameras and between them, and one window of each.

    Each picture is divided into about `cells` windows of equal size. Each view shows another one, in random order, so
    that together the views show all parts of a picture equally often.

    Args:
        count: number of views; at most two for each camera.
        cells: number of windows of a picture; 1 for whole pictures. At most as many as there are views.
        seed: random seed of the views between cameras, and of the order of windows.
    """
    at_cameras, between_cameras = sample_views(cameras, count // 2, seed)
    views = [view for pair in zip(at_cameras, between_cameras, strict=True) for view in pair]
    cells = max(1, min(cells, len(views)))
    columns = round(cells**0.5)
    rows = cells // columns
    order = np.random.default_rng(seed).permutation(columns * rows)
    windows = []
    for number, view in enumerate(views):
        position = number // 2 + (number % 2) * (len(order) // 2)  # Both kinds of views show all cells.
        grid = divide_view(view, columns, rows)
        windows.append(grid[order[position % len(order)] % len(grid)])
    return Windows(windows, columns, rows)


def interpolate_views(
    cameras: Sequence[Camera],
    seed: int = 0,
    indices: Sequence[int] | None = None,
    size_ratio: float = INTERPOLATED_VIEW_SIZE_RATIO,
) -> list[Camera]:
    """Interpolate between each camera and a neighbour with a similar viewing direction, by default in a wider picture.

    Like held-out photos, these views show what lies between the training photos and just outside them. The neighbour is
    drawn from the nearest cameras, and the view lies 25 to 75 % of the way to it.

    Args:
        cameras: all cameras; neighbours are searched among them.
        seed: random seed for the choice of neighbours and of positions between them.
        indices: cameras to interpolate from; None for all.
        size_ratio: width and height of a picture, as multiples of those of the camera.

    Returns:
        One view for each index. With fewer than two cameras, the cameras themselves.
    """
    indices = list(range(len(cameras)) if indices is None else indices)
    if len(cameras) < 2:
        return [cameras[index] for index in indices]
    rng = np.random.default_rng(seed)
    positions = np.array([camera.position for camera in cameras])
    rotations = Rotation.from_matrix(np.array([camera.rotation for camera in cameras]))
    distances = np.linalg.norm(positions[indices, None] - positions, axis=2)
    distances[np.arange(len(indices)), indices] = np.inf  # a camera is no neighbour of itself
    unit = float(np.median(distances.min(axis=1))) or 1.0
    views = []
    for row, index in enumerate(indices):
        camera = cameras[index]
        cost = distances[row] + _ROTATION_COST_PER_RADIAN * unit * (rotations[index].inv() * rotations).magnitude()
        other = np.argsort(cost, kind="stable")[rng.integers(min(_NEIGHBOUR_CANDIDATES, len(cameras) - 1))]
        share = rng.uniform(0.25, 0.75)
        rotation = Slerp((0, 1), Rotation.concatenate([rotations[index], rotations[other]]))(share).as_matrix()
        pose = np.eye(4)
        pose[:3, :3] = rotation
        pose[:3, 3] = -rotation @ ((1 - share) * positions[index] + share * positions[other])
        views.append(_enlarge(dataclasses.replace(camera, camera_from_world=pose), size_ratio))
    return views


def shrink_camera(camera: Camera, max_side: int = MAX_SMALL_VIEW_SIDE_PIXELS) -> Camera:
    """Shrink a camera's picture to at most `max_side` pixels on its longer side; the view stays about the same."""
    return resize_camera(camera, min(1.0, max_side / max(camera.width, camera.height)))


def resize_camera(camera: Camera, ratio: float) -> Camera:
    """Return a camera whose picture has a ratio of the pixels of each axis; the view stays about the same."""
    width, height = (max(1, round(ratio * side)) for side in (camera.width, camera.height))
    return fit_camera(camera, width, height)


def fit_camera(camera: Camera, width: int, height: int) -> Camera:
    """Return a camera with the same view whose picture has `width` x `height` pixels."""
    x, y = width / camera.width, height / camera.height
    return dataclasses.replace(
        camera, width=width, height=height, fx=camera.fx * x, fy=camera.fy * y, cx=camera.cx * x, cy=camera.cy * y
    )


def divide_view(camera: Camera, columns: int, rows: int) -> list[Camera]:
    """Divide a camera's picture into a grid of windows, and return a camera for each window, row by row.

    The pixels of the windows are those of the picture. A picture of fewer pixels has fewer columns or rows.
    """
    columns, rows = min(columns, camera.width), min(rows, camera.height)
    lefts, tops = (
        [place * side // count for place in range(count + 1)]
        for side, count in ((camera.width, columns), (camera.height, rows))
    )
    return [
        dataclasses.replace(camera, width=right - left, height=bottom - top, cx=camera.cx - left, cy=camera.cy - top)
        for top, bottom in pairwise(tops)
        for left, right in pairwise(lefts)
    ]


def _enlarge(camera: Camera, ratio: float) -> Camera:
    """Enlarge the picture on all sides at the same focal lengths."""
    width, height = round(ratio * camera.width), round(ratio * camera.height)
    return dataclasses.replace(
        camera,
        width=width,
        height=height,
        cx=camera.cx + (width - camera.width) / 2,
        cy=camera.cy + (height - camera.height) / 2,
    )

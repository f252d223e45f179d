"""Divide the ground plane into cells with about equal shares of the points and cameras."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hyrfpack.cameras.paths import estimate_up
from hyrfpack.scene import Scene

OVERLAP_RATIO = 0.1  # An extended cell reaches this share of the mean side of a cell beyond each of its borders.
# The longer side of the ground is found from this percentage of points and cameras, those nearest to the median.
INNER_PERCENTILE = 90
EXTENT_PERCENTILES = (1, 99)  # Coordinates outside these do not count for the size of the ground.


@dataclass(frozen=True, eq=False)
class Cells:
    """Cells that tile the ground plane: columns, each of which is divided into rows of its own.

    Outer cells have no outer border. So every point of space lies above or below exactly one cell, and points far
    outside belong to the nearest outer one. Cell `column * R + row` has the row `row` of R.

    Attributes:
        axes: (2, 3) orthogonal unit vectors of the ground plane in world axes.
        column_borders: (C + 1,) ascending coordinates along the first axis, from -inf to inf.
        row_borders: (C, R + 1) ascending coordinates along the second axis in each column, from -inf to inf.
        overlap: (2,) distances along the axes by which `find_extended` extends cells.
    """

    axes: np.ndarray
    column_borders: np.ndarray
    row_borders: np.ndarray
    overlap: np.ndarray

    @property
    def count(self) -> int:
        """Return the number of cells."""
        columns, borders = self.row_borders.shape
        return columns * (borders - 1)

    def name_cell(self, cell: int) -> str:
        """Return the name of a cell, "column-row", both counted from 1."""
        column, row = divmod(cell, self.row_borders.shape[1] - 1)
        return f"{column + 1}-{row + 1}"

    def find(self, positions: np.ndarray) -> np.ndarray:
        """Return the cell (N,) int64 of each position (N, 3)."""
        u, v = self.axes @ np.asarray(positions, np.float64).T
        column = np.searchsorted(self.column_borders[1:-1], u, side="right")
        row = (v[:, None] >= self.row_borders[column, 1:-1]).sum(axis=1)
        return column * (self.row_borders.shape[1] - 1) + row

    def find_extended(self, positions: np.ndarray) -> np.ndarray:
        """Return whether each position (N, 3) lies in each extended cell, (N, cells) bool."""
        u, v = self.axes @ np.asarray(positions, np.float64).T
        (along, across), columns = self.overlap, self.column_borders
        inside = []
        for low, high, rows in zip(columns[:-1], columns[1:], self.row_borders, strict=True):
            in_column = (u >= low - along) & (u < high + along)
            inside += [
                in_column & (v >= first - across) & (v < last + across)
                for first, last in zip(rows[:-1], rows[1:], strict=True)
            ]
        return np.stack(inside, axis=1)


def ground_axes(scene: Scene) -> np.ndarray:
    """Return two orthogonal unit vectors (2, 3) of the ground plane, the first along the longer side of the scene.

    That is the direction in which points and cameras spread most, without the outermost ones.
    """
    up, _ = estimate_up([view.camera for view in scene.train])
    right = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    right /= np.linalg.norm(right)
    plane = np.stack((right, np.cross(up, right)))
    footprint, weights = _weighted_footprint(scene, plane)
    offsets = footprint - np.median(footprint, axis=0)
    distances = np.linalg.norm(offsets, axis=1)
    inner = distances <= np.percentile(distances, INNER_PERCENTILE)
    _, vectors = np.linalg.eigh((weights[inner, None] * offsets[inner]).T @ offsets[inner])
    longest = vectors[:, -1] * np.sign(vectors[np.abs(vectors[:, -1]).argmax(), -1])
    return np.stack((longest, (-longest[1], longest[0]))) @ plane


def ground_extent(scene: Scene, axes: np.ndarray) -> np.ndarray:
    """Return the size (2,) of the ground along its axes, without a few outermost points and cameras."""
    low, high = np.percentile(_weighted_footprint(scene, axes)[0], EXTENT_PERCENTILES, axis=0)
    return high - low


def divide_ground(scene: Scene, columns: int, rows: int) -> Cells:
    """Divide the ground plane into columns x rows cells.

    Each column has the same share of points and cameras, and so has each cell of a column. All points together weigh as
    much as all cameras.
    """
    axes = ground_axes(scene)
    footprint, weights = _weighted_footprint(scene, axes)
    column_borders = _find_borders(footprint[:, 0], weights, columns)
    column = np.searchsorted(column_borders[1:-1], footprint[:, 0], side="right")
    row_borders = [_find_borders(footprint[column == c, 1], weights[column == c], rows) for c in range(columns)]
    overlap = OVERLAP_RATIO * ground_extent(scene, axes) / (columns, rows)
    return Cells(axes, column_borders, np.stack(row_borders), overlap)


def _weighted_footprint(scene: Scene, axes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return coordinates (N, 2) of all points and cameras on the ground, and their weights (N,)."""
    cameras = np.array([view.camera.position for view in scene.train])
    places = np.concatenate((scene.points, cameras))
    weights = np.repeat((1 / max(1, len(scene.points)), 1 / len(cameras)), (len(scene.points), len(cameras)))
    return places @ axes.T, weights


def _find_borders(values: np.ndarray, weights: np.ndarray, count: int) -> np.ndarray:
    """Return borders (count + 1,) from -inf to inf that divide weighted values into parts of equal weight."""
    if not len(values):
        return np.r_[-np.inf, np.full(count - 1, np.inf), np.inf]
    order = np.argsort(values, kind="stable")
    cumulative = np.cumsum(weights[order])
    places = np.searchsorted(cumulative, cumulative[-1] * np.arange(1, count) / count)
    return np.r_[-np.inf, values[order][np.minimum(places, len(values) - 1)], np.inf]

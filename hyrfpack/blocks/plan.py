"""Assign the photos and points of a scene to blocks."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hyrfpack.blocks.cells import Cells, divide_ground
from hyrfpack.errors import HyrfError
from hyrfpack.format.sections import MAX_PARTS
from hyrfpack.scene import Scene, View

# A photo belongs to every block that holds at least this share of the points that it shows.
MIN_PHOTO_SHARE = 0.1
MIN_BLOCK_PHOTOS = 4  # A block with fewer is merged into the nearest one.
_GRID_PATTERN = re.compile(r"([1-9]\d{0,3})x([1-9]\d{0,3})")


@dataclass(frozen=True, eq=False)
class Block:
    """A part of the ground with the photos that train it.

    Attributes:
        name: name of its first cell.
        cells: its cells, ascending; more than one if others were merged into it.
        photos: the photos that show it.
        point_mask: (P,) bool, which points of the whole scene it starts from.
    """

    name: str
    cells: tuple[int, ...]
    photos: list[View]
    point_mask: np.ndarray

    @property
    def point_count(self) -> int:
        """Return the number of points that it starts from."""
        return int(self.point_mask.sum())

    def cut(self, scene: Scene) -> Scene:
        """Return the photos of the block, none of them held out, and its points, of the whole scene."""
        new_row = np.cumsum(self.point_mask) - 1
        rows_by_name = {view.name: scene.tracks[view.name] for view in self.photos if view.name in scene.tracks}
        return replace(
            scene,
            train=self.photos,
            test=[],
            points=scene.points[self.point_mask],
            point_colors=scene.point_colors[self.point_mask],
            tracks={name: new_row[rows[self.point_mask[rows]]] for name, rows in rows_by_name.items()},
            reading={},
        )


@dataclass(frozen=True, eq=False)
class BlockPlan:
    """The division of a scene into blocks.

    Attributes:
        cells: the cells of all blocks.
        blocks: the blocks, those with the most photos first.
    """

    cells: Cells
    blocks: list[Block]

    def core_mask(self, block: Block, positions: np.ndarray) -> np.ndarray:
        """Return which positions (N, 3) lie in the cells of a block, (N,) bool."""
        return np.isin(self.cells.find(positions), block.cells)


def parse_grid(blocks: str) -> tuple[int, int]:
    """Return the numbers of columns and rows that a text such as "2x3" states.

    Raises:
        HyrfError: the text is no grid, or has more cells than a file has parts.
    """
    match = _GRID_PATTERN.fullmatch(blocks)
    if match is None:
        raise HyrfError(
            f"'{blocks}' is no grid of blocks", fix="use `blocks=auto`, or columns and rows as in `blocks=2x2`"
        )
    columns, rows = int(match[1]), int(match[2])
    if columns * rows > MAX_PARTS:
        raise HyrfError(
            f"{blocks} are {columns * rows:,} blocks, and a file holds at most {MAX_PARTS} parts",
            fix="use a smaller grid as `blocks`",
        )
    return columns, rows


def plan_blocks(scene: Scene, columns: int, rows: int) -> BlockPlan:
    """Divide a scene into at most columns x rows blocks.

    A photo belongs to every block whose extended cell holds at least MIN_PHOTO_SHARE of the points that it shows, and
    to the one whose cell holds most of them. A photo that shows no point belongs to the block that its camera stands
    in. Blocks with fewer than MIN_BLOCK_PHOTOS photos are merged into the nearest one. The points of a block are those
    in its cells, and all others that its photos show.

    Raises:
        HyrfError: the scene has no points, or too few photos for so many blocks.
    """
    photos = scene.train
    if not len(scene.points):
        raise HyrfError(
            f"{scene.path}: there are no points, which say what each photo shows",
            fix="train without `blocks`, or repeat the reconstruction",
        )
    if columns * rows > max(1, len(photos) // MIN_BLOCK_PHOTOS):
        raise HyrfError(
            f"{scene.path}: {len(photos)} training photos are too few for {columns}x{rows} blocks",
            fix=f"use at most {max(1, len(photos) // MIN_BLOCK_PHOTOS)} blocks; each needs {MIN_BLOCK_PHOTOS} photos",
        )
    cells = divide_ground(scene, columns, rows)
    point_cells, shown_points = cells.find(scene.points), [scene.shown_points(view) for view in photos]
    is_member = _assign_photos(cells, scene.points, point_cells, photos, shown_points)
    blocks = []
    for group in _merge_small_groups(cells, scene.points, point_cells, is_member):
        members = np.flatnonzero(is_member[:, group].any(axis=1))
        point_mask = np.isin(point_cells, group)
        for photo in members:
            point_mask[shown_points[photo]] = True
        blocks.append(Block(cells.name_cell(group[0]), tuple(group), [photos[n] for n in members], point_mask))
    return BlockPlan(cells, sorted(blocks, key=lambda block: (-len(block.photos), block.cells)))


def _assign_photos(
    cells: Cells,
    points: np.ndarray,
    point_cells: np.ndarray,
    photos: Sequence[View],
    shown_points: Sequence[np.ndarray],
) -> np.ndarray:
    """Return which photos belong to which cells, (photos, cells) bool.

    Args:
        cells: the cells.
        points: (P, 3) points of the scene.
        point_cells: (P,) cell of each point.
        photos: the training photos.
        shown_points: indices of the points that each photo shows.
    """
    extended = cells.find_extended(points)
    is_member = np.zeros((len(photos), cells.count), bool)
    stands_in = cells.find(np.array([view.camera.position for view in photos]))
    for photo, rows in enumerate(shown_points):
        if not len(rows):
            is_member[photo, stands_in[photo]] = True
            continue
        is_member[photo] = extended[rows].mean(axis=0) >= MIN_PHOTO_SHARE
        is_member[photo, np.bincount(point_cells[rows], minlength=cells.count).argmax()] = True
    return is_member


def _merge_small_groups(
    cells: Cells, points: np.ndarray, point_cells: np.ndarray, is_member: np.ndarray
) -> list[list[int]]:
    """Return groups of cells that have enough photos; the smallest is merged into the nearest one until all have."""
    groups = [[cell] for cell in range(cells.count)]
    ground = points @ cells.axes.T
    while len(groups) > 1:
        counts = [int(is_member[:, group].any(axis=1).sum()) for group in groups]
        if min(counts) >= MIN_BLOCK_PHOTOS:
            break
        smallest = groups.pop(counts.index(min(counts)))
        center = _find_center(cells, ground, point_cells, smallest)
        offsets = [_find_center(cells, ground, point_cells, group) - center for group in groups]
        distances = [float(np.linalg.norm(offset)) for offset in offsets]
        nearest = groups[distances.index(min(distances))]
        nearest[:] = sorted(nearest + smallest)
    return groups


def _find_center(cells: Cells, ground: np.ndarray, point_cells: np.ndarray, group: Sequence[int]) -> np.ndarray:
    """Return the centre (2,) of a group of cells on the ground: the mean of its points, or of its inner borders."""
    inside = np.isin(point_cells, group)
    if inside.any():
        return ground[inside].mean(axis=0)
    column, row = divmod(group[0], cells.row_borders.shape[1] - 1)
    borders = cells.column_borders[column : column + 2], cells.row_borders[column, row : row + 2]
    return np.array([inner[np.isfinite(inner)].mean() if np.isfinite(inner).any() else 0.0 for inner in borders])

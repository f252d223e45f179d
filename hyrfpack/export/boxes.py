"""Boxes around splats, and a binary tree of them, for formats that stream a scene by its regions."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from hyrfpack.rotations import rotation_matrices
from hyrfpack.splats.splats import Splats

BOX_SIGMAS = 3.0
_NO_TURN = np.eye(3)


@dataclass(frozen=True, eq=False)
class Box:
    """An axis-aligned box with the corners `low` and `high`, (3,) each."""

    low: np.ndarray
    high: np.ndarray

    @classmethod
    def around(cls, boxes: Sequence[Box]) -> Box:
        """Return the smallest box that holds other boxes, at least one."""
        return cls(np.min([box.low for box in boxes], axis=0), np.max([box.high for box in boxes], axis=0))

    @classmethod
    def of_splats(cls, splats: Splats, turn: np.ndarray = _NO_TURN) -> Box:
        """Return the smallest box that holds the ellipsoids of splats, at least one, at BOX_SIGMAS deviations.

        The half side along axis i of the box of an ellipsoid with the rotation R and the scales s is

            BOX_SIGMAS sqrt(sum_j (R_ij s_j)^2)

        Args:
            splats: the splats.
            turn: (3, 3) rotation that maps the splats to the axes of the box.
        """
        axes = turn @ rotation_matrices(splats.quats.astype(np.float64)) * splats.scales[:, None]
        reach = BOX_SIGMAS * np.linalg.norm(axes, axis=2)
        centers = splats.positions @ turn.T
        return cls((centers - reach).min(axis=0), (centers + reach).max(axis=0))

    @property
    def center(self) -> np.ndarray:
        """The centre (3,)."""
        return (self.low + self.high) / 2

    @property
    def half_sides(self) -> np.ndarray:
        """Half of the length of each side (3,)."""
        return (self.high - self.low) / 2

    @property
    def diagonal(self) -> float:
        """The length of the diagonal."""
        return float(np.linalg.norm(self.high - self.low))


@dataclass(frozen=True, eq=False)
class BoxTree:
    """A node of a binary tree of boxes.

    Attributes:
        box: holds the boxes of all leaves below this node.
        leaf: number of the box that this leaf stands for; None for a node with children.
        children: two nodes, or none for a leaf.
    """

    box: Box
    leaf: int | None = None
    children: tuple[BoxTree, ...] = ()

    @classmethod
    def build(cls, boxes: Sequence[Box], numbers: Sequence[int] | None = None) -> BoxTree:
        """Build a tree over boxes, halved at the median of their centres along the axis of the largest spread.

        Args:
            boxes: all boxes.
            numbers: numbers of the boxes below the node, at least one; None for all.
        """
        numbers = range(len(boxes)) if numbers is None else numbers
        box = Box.around([boxes[number] for number in numbers])
        if len(numbers) == 1:
            return cls(box, numbers[0])
        centers = np.stack([boxes[number].center for number in numbers])
        axis = int(np.ptp(centers, axis=0).argmax())
        ordered = [numbers[position] for position in np.argsort(centers[:, axis], kind="stable").tolist()]
        half = len(ordered) // 2
        return cls(box, None, (cls.build(boxes, ordered[:half]), cls.build(boxes, ordered[half:])))

    def leaves(self) -> Iterator[int]:
        """Yield the numbers of all leaves from left to right."""
        if self.leaf is not None:
            yield self.leaf
        for child in self.children:
            yield from child.leaves()

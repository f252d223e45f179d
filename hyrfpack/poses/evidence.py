"""What speaks for a reconstruction: the share of the matches between photos that it explains.

A mapper's own figures (reprojection error, track length) are of what it kept. This counts over all that was matched, so
that reconstructions by different mappers, and those that lack photos, can be held beside each other.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

ERROR = 2.0  # pixels, of the pictures that were matched: the most that an explained match is off its epipolar line


@dataclass(frozen=True, eq=False)
class Matches:
    """The verified matches of a pair of photos, as rays.

    Attributes:
        first, second: names of the photos.
        rays1, rays2: (M, 2) X/Z and Y/Z at depth 1, lens distortion undone.
        pixel: size of a pixel in that unit, the mean of both photos.
    """

    first: str
    second: str
    rays1: np.ndarray
    rays2: np.ndarray
    pixel: float


def explained(poses: Mapping[str, np.ndarray], pair: Matches) -> np.ndarray:
    """(M,) bool: which matches lie on each other's epipolar lines (Sampson's distance) and in front of both cameras.

    Args:
        poses: (3, 4) camera_from_world by photo; both photos of the pair are among them.
        pair: the matches.
    """
    first, second = poses[pair.first], poses[pair.second]
    rotation = second[:, :3] @ first[:, :3].T
    shift = second[:, 3] - rotation @ first[:, 3]
    x1, x2 = (np.column_stack([rays, np.ones(len(rays))]) for rays in (pair.rays1, pair.rays2))
    cross = np.array([[0, -shift[2], shift[1]], [shift[2], 0, -shift[0]], [-shift[1], shift[0], 0]])
    essential = cross @ rotation
    line2, line1 = x1 @ essential.T, x2 @ essential
    slope = (line2[:, :2] ** 2).sum(1) + (line1[:, :2] ** 2).sum(1)
    error = np.abs((x2 * line2).sum(1)) / np.sqrt(np.maximum(slope, 1e-30))
    # Depths d1, d2 that bring the rays nearest: d2 x2 = d1 R x1 + t, least squares by hand.
    turned = x1 @ rotation.T
    a, b, c = (turned**2).sum(1), (turned * x2).sum(1), (x2**2).sum(1)
    p, q = turned @ shift, x2 @ shift
    below = np.maximum(a * c - b * b, 1e-30)
    in_front = ((b * q - c * p) / below > 0) & ((a * q - b * p) / below > 0)
    return (error < ERROR * pair.pixel) & in_front


def evidence(poses: Mapping[str, np.ndarray], pairs: Sequence[Matches]) -> int:
    """How many matches a reconstruction explains.

    Args:
        poses: (3, 4) camera_from_world by photo.
        pairs: matches; those of photos without a pose count as not explained.
    """
    posed = (pair for pair in pairs if pair.first in poses and pair.second in poses)
    return sum(int(explained(poses, pair).sum()) for pair in posed)

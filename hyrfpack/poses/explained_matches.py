"""Count the matches between photos that a reconstruction explains, by which reconstructions can be compared.

A mapper's own figures (reprojection error, track length) describe only the points that it kept. This count covers all
verified matches, so it is comparable between mappers and between reconstructions that lack different photos.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

MAX_EPIPOLAR_ERROR_PIXELS = 2.0  # in pixels of the working copies, in which features were matched


@dataclass(frozen=True, eq=False)
class RayMatches:
    """Verified matches between two photos, as viewing rays.

    Attributes:
        first, second: names of the photos.
        rays1, rays2: (M, 2) normalised image coordinates X/Z and Y/Z without lens distortion.
        pixel: size of a pixel in normalised coordinates, the mean of both photos.
    """

    first: str
    second: str
    rays1: np.ndarray
    rays2: np.ndarray
    pixel: float


def explained_mask(poses: Mapping[str, np.ndarray], pair: RayMatches) -> np.ndarray:
    """Return which matches the poses explain.

    A match is explained if its Sampson distance from the epipolar geometry is small and its point lies in front of both
    cameras.

    Args:
        poses: (3, 4) camera_from_world by photo name, among them both photos of the pair.
        pair: the matches of the pair.

    Returns:
        (M,) bool mask.
    """
    first, second = poses[pair.first], poses[pair.second]
    rotation = second[:, :3] @ first[:, :3].T
    shift = second[:, 3] - rotation @ first[:, 3]
    x1, x2 = (np.column_stack([rays, np.ones(len(rays))]) for rays in (pair.rays1, pair.rays2))
    cross = np.array([[0, -shift[2], shift[1]], [shift[2], 0, -shift[0]], [-shift[1], shift[0], 0]])
    essential = cross @ rotation
    lines2, lines1 = x1 @ essential.T, x2 @ essential
    squared_gradient = (lines2[:, :2] ** 2).sum(1) + (lines1[:, :2] ** 2).sum(1)
    error = np.abs((x2 * lines2).sum(1)) / np.sqrt(np.maximum(squared_gradient, 1e-30))
    # The depths d1 and d2 solve d2 x2 = d1 R x1 + t by least squares, in closed form.
    rotated_rays = x1 @ rotation.T
    a, b, c = (rotated_rays**2).sum(1), (rotated_rays * x2).sum(1), (x2**2).sum(1)
    p, q = rotated_rays @ shift, x2 @ shift
    determinant = np.maximum(a * c - b * b, 1e-30)
    in_front = ((b * q - c * p) / determinant > 0) & ((a * q - b * p) / determinant > 0)
    return (error < MAX_EPIPOLAR_ERROR_PIXELS * pair.pixel) & in_front


def count_explained_matches(poses: Mapping[str, np.ndarray], pairs: Sequence[RayMatches]) -> int:
    """Return the number of matches that a reconstruction explains.

    Args:
        poses: (3, 4) camera_from_world by photo name.
        pairs: matches of all pairs; those of photos without a pose count as not explained.
    """
    posed = (pair for pair in pairs if pair.first in poses and pair.second in poses)
    return sum(int(explained_mask(poses, pair).sum()) for pair in posed)

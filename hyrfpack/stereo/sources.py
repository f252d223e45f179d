"""Choose the photos from which the depths of a photo are estimated."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hyrfpack.scene import Camera

MAX_SOURCES = 4
MIN_SHARED_POINTS = 5
MAX_MEASURED_POINTS = 256  # angles are measured at no more shared points, to save time
# Points seen from directions that differ by this angle have precise depths and still look alike.
BEST_ANGLE_DEGREES = 5.0
# Where the median angle is smaller, photos say nothing about depth; where it is larger, windows look too different.
MIN_ANGLE_DEGREES = 1.0
MAX_ANGLE_DEGREES = 30.0
# Standard deviations of the Gaussian weight of angles, below and above the best angle.
SMALLER_ANGLE_STD_DEGREES = 2.5
LARGER_ANGLE_STD_DEGREES = 10.0


def choose_sources(cameras: Sequence[Camera], points: np.ndarray, seen: Sequence[np.ndarray]) -> list[list[int]]:
    """Choose for each photo the others that show most of its points from suitable directions.

    The score of another photo is the sum over shared points of exp(-(a - b)^2 / 2 s^2). Here a is the triangulation
    angle of the point, b is `BEST_ANGLE_DEGREES`, and s is the standard deviation below or above b.

    Args:
        cameras: the cameras of N photos.
        points: (P, 3) world positions.
        seen: for each photo the indices of the points that it shows.

    Returns:
        For each photo the indices of at most `MAX_SOURCES` others, the best one first. Photos that share fewer than
        `MIN_SHARED_POINTS` points are left out, and those where the median angle is below `MIN_ANGLE_DEGREES` or above
        `MAX_ANGLE_DEGREES`.
    """
    shown = [np.unique(indices) for indices in seen]
    centers = [camera.position for camera in cameras]
    scores = np.zeros((len(cameras), len(cameras)))
    is_shown = np.zeros(len(points), bool)  # by the first photo of a pair
    for first in range(len(cameras)):
        is_shown[:] = False
        is_shown[shown[first]] = True
        for second in range(first + 1, len(cameras)):
            shared = shown[second][is_shown[shown[second]]]
            if len(shared) >= MIN_SHARED_POINTS:
                sampled = shared[:: -(-len(shared) // MAX_MEASURED_POINTS)]
                angles = _triangulation_angles(points[sampled], centers[first], centers[second])
                if MIN_ANGLE_DEGREES <= np.median(angles) <= MAX_ANGLE_DEGREES:
                    scores[first, second] = scores[second, first] = len(shared) * _weigh_angles(angles).mean()
    best = np.argsort(-scores, axis=1, kind="stable")[:, :MAX_SOURCES]
    return [[int(index) for index in row if own[index] > 0] for row, own in zip(best, scores, strict=True)]


def _weigh_angles(degrees: np.ndarray) -> np.ndarray:
    """Return the weights (N,) of triangulation angles, 1 at the best one."""
    std = np.where(degrees < BEST_ANGLE_DEGREES, SMALLER_ANGLE_STD_DEGREES, LARGER_ANGLE_STD_DEGREES)
    return np.exp(-((degrees - BEST_ANGLE_DEGREES) ** 2) / (2 * std**2))


def _triangulation_angles(points: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the angles (N,) in degrees between the rays from points (N, 3) to two camera positions."""
    a, b = points - first, points - second
    lengths = np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1)
    cosines = (a * b).sum(1) / np.maximum(lengths, np.finfo(float).tiny)
    return np.asarray(np.degrees(np.arccos(np.clip(cosines, -1, 1))))

"""Choose the photos that a photo is compared with to find its depths."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from hyrfpack.scene import Camera

MAX_SOURCES = 4
MIN_SHARED_POINTS = 5
MAX_MEASURED_POINTS = 256  # The angles of at most so many shared points are measured.
# Points seen from directions that differ by this angle have precise depths and still look alike.
BEST_ANGLE_DEGREES = 5.0
# Where the median angle is smaller, photos say nothing about depth; where it is larger, windows look too different.
MIN_ANGLE_DEGREES = 1.0
MAX_ANGLE_DEGREES = 30.0
# Standard deviation of the weights of smaller and larger angles.
SMALLER_ANGLES_DEGREES = 2.5
LARGER_ANGLES_DEGREES = 10.0


def choose_sources(cameras: Sequence[Camera], points: np.ndarray, seen: Sequence[np.ndarray]) -> list[list[int]]:
    """Choose for each photo the others that show most of its points from suitable directions.

    A shared point counts exp(-(a - b)^2 / 2 s^2), where a is the angle between the two directions from which it is
    seen and b `BEST_ANGLE_DEGREES`.

    Args:
        cameras: the cameras of N photos.
        points: (P, 3) world positions.
        seen: for each photo the indices of the points that it shows.

    Returns:
        For each photo the indices of at most `MAX_SOURCES` others, the best one first. Photos that share fewer than
        `MIN_SHARED_POINTS` points are left out, and those where the median angle is below `MIN_ANGLE_DEGREES` or above
        `MAX_ANGLE_DEGREES`.
    """
    shows = np.zeros((len(cameras), len(points)), bool)
    for row, indices in zip(shows, seen, strict=True):
        row[indices] = True
    centers = [camera.position for camera in cameras]
    scores = np.zeros((len(cameras), len(cameras)))
    for first, second in combinations(range(len(cameras)), 2):
        shared = np.flatnonzero(shows[first] & shows[second])
        if len(shared) >= MIN_SHARED_POINTS:
            some = shared[:: -(-len(shared) // MAX_MEASURED_POINTS)]
            angles = _angles(points[some], centers[first], centers[second])
            if MIN_ANGLE_DEGREES <= np.median(angles) <= MAX_ANGLE_DEGREES:
                spread = np.where(angles < BEST_ANGLE_DEGREES, SMALLER_ANGLES_DEGREES, LARGER_ANGLES_DEGREES)
                weights = np.exp(-((angles - BEST_ANGLE_DEGREES) ** 2) / (2 * spread**2))
                scores[first, second] = scores[second, first] = len(shared) * weights.mean()
    best = np.argsort(-scores, axis=1, kind="stable")[:, :MAX_SOURCES]
    return [[int(index) for index in row if own[index] > 0] for row, own in zip(best, scores, strict=True)]


def _angles(points: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the angles (N,) in degrees between the directions in which two places see points (N, 3)."""
    a, b = points - first, points - second
    lengths = np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1)
    cosines = (a * b).sum(1) / np.maximum(lengths, np.finfo(float).tiny)
    return np.asarray(np.degrees(np.arccos(np.clip(cosines, -1, 1))))

"""Rotations as unit quaternions (w, x, y, z) and as matrices."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

Quaternion = tuple[float, float, float, float]
IDENTITY: Quaternion = (1.0, 0.0, 0.0, 0.0)
MAX_LENGTH_ERROR = 1e-6  # of the length of a quaternion that stands for a rotation


def check_rotation(quat: Sequence[float]) -> None:
    """Raise ValueError unless four numbers are a quaternion of unit length, to within MAX_LENGTH_ERROR."""
    # A NaN makes the comparison false.
    if len(quat) != 4 or not abs(math.hypot(*quat) - 1) <= MAX_LENGTH_ERROR:
        raise ValueError(f"the rotation {tuple(quat)!r:.120} is no quaternion of unit length")


def rotation_matrix(quat: Sequence[float]) -> np.ndarray:
    """Convert a quaternion wxyz of nearly unit length to a rotation matrix (3, 3) float64, after normalising it.

    Raises:
        ValueError: see `check_rotation`.
    """
    check_rotation(quat)
    return rotation_matrices(np.array([quat], np.float64) / math.hypot(*quat))[0]


def rotation_matrices(quats: np.ndarray) -> np.ndarray:
    """Convert unit quaternions (N, 4) wxyz to rotation matrices (N, 3, 3) of the same dtype."""
    w, x, y, z = quats.T
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, axis=1) for row in rows], axis=1)


def quaternion_from_matrix(rotation: np.ndarray) -> np.ndarray:
    """Convert a proper rotation (3, 3) to a unit quaternion (4,) float64 wxyz with w >= 0."""
    r = np.asarray(rotation, np.float64)
    # This is the outer product of the quaternion with itself. Its column with the largest diagonal entry is computed
    # without cancellation.
    outer = np.empty((4, 4))
    outer[0, 0] = 1 + r[0, 0] + r[1, 1] + r[2, 2]
    outer[1, 1] = 1 + r[0, 0] - r[1, 1] - r[2, 2]
    outer[2, 2] = 1 - r[0, 0] + r[1, 1] - r[2, 2]
    outer[3, 3] = 1 - r[0, 0] - r[1, 1] + r[2, 2]
    outer[0, 1] = outer[1, 0] = r[2, 1] - r[1, 2]
    outer[0, 2] = outer[2, 0] = r[0, 2] - r[2, 0]
    outer[0, 3] = outer[3, 0] = r[1, 0] - r[0, 1]
    outer[1, 2] = outer[2, 1] = r[0, 1] + r[1, 0]
    outer[1, 3] = outer[3, 1] = r[0, 2] + r[2, 0]
    outer[2, 3] = outer[3, 2] = r[1, 2] + r[2, 1]
    quat = outer[np.argmax(np.diagonal(outer))]
    quat = quat / np.linalg.norm(quat)
    return -quat if quat[0] < 0 else quat


def multiply_quats(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the Hamilton products (N, 4) of a quaternion (4,) with quaternions (N, 4), all wxyz."""
    w, v = first[0], first[1:]
    s, u = second[:, :1], second[:, 1:]
    return np.concatenate((w * s - u @ v[:, None], w * u + s * v + np.cross(v, u)), axis=1)

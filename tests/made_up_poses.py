"""Synthetic reconstructions: poses by file name, and the same poses in another world frame."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation


def circle_poses(count: int = 24, noise: float = 0.0, seed: int = 0) -> dict[str, np.ndarray]:
    """Return poses of cameras on a circle around the origin, which they look at."""
    rng, poses = np.random.default_rng(seed), {}
    for number in range(count):
        angle = 2 * np.pi * number / count
        place = np.array([3 * np.cos(angle), 3 * np.sin(angle), 0.3 * np.sin(3 * angle)]) + rng.normal(0, noise, 3)
        forward = -place / np.linalg.norm(place)
        right = np.cross(forward, [0, 0, 1])
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        poses[f"{number:03d}.jpg"] = np.column_stack([rotation, -rotation @ place])
    return poses


def line_poses(count: int = 12) -> dict[str, np.ndarray]:
    """Return poses of cameras that move straight ahead."""
    return {f"{n:03d}.jpg": np.column_stack([np.eye(3), [0, 0, -float(n)]]) for n in range(count)}


def transform_poses(poses: dict[str, np.ndarray], scale: float = 2.5, seed: int = 1) -> dict[str, np.ndarray]:
    """Return the same poses in a world frame that is rotated, scaled and shifted."""
    rotation = Rotation.random(random_state=seed).as_matrix()
    result = {}
    for name, pose in poses.items():
        place = scale * rotation @ (-pose[:, :3].T @ pose[:, 3]) + np.array([5.0, -2.0, 1.0])
        turned = pose[:, :3] @ rotation.T
        result[name] = np.column_stack([turned, -turned @ place])
    return result

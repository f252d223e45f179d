"""Photos of textured planes whose depths are known."""

from __future__ import annotations

import numpy as np

from hyrfpack.scene import Camera
from hyrfpack.stereo import StereoPhoto

PICTURE_WIDTH, PICTURE_HEIGHT = 64, 48


def camera_at(x: float, y: float = 0.0, z: float = 0.0, turn: float = 0.0) -> Camera:
    """Return a camera at a place that looks along z, turned by `turn` radians about its y axis."""
    c, s = np.cos(turn), np.sin(turn)
    rotation = np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ (x, y, z)
    return Camera(PICTURE_WIDTH, PICTURE_HEIGHT, 60.0, 60.0, PICTURE_WIDTH / 2, PICTURE_HEIGHT / 2, pose)


def texture(x: np.ndarray, y: np.ndarray, seed: int = 0) -> np.ndarray:
    """Return smooth random values in [0, 1] at places of a plane: a sum of waves of 0.15 to 1 units."""
    generator = np.random.default_rng(seed)
    total = np.zeros_like(x)
    for _ in range(24):
        angle, phase = generator.uniform(0, 2 * np.pi, 2)
        frequency = 2 * np.pi / generator.uniform(0.15, 1.0)
        total += np.sin(frequency * (x * np.cos(angle) + y * np.sin(angle)) + phase)
    return np.clip(0.5 + total / 14, 0, 1)


def depths_of_planes(camera: Camera, planes) -> tuple[np.ndarray, np.ndarray]:
    """Return camera z (H, W) of the nearest of some planes, and its grey values; planes as in `photograph`."""
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    rays = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], -1) @ camera.rotation
    depth, grey = np.full(x.shape, np.inf), np.zeros(x.shape)
    for number, (distance, slope, left, right) in enumerate(planes):
        # The plane z = distance + slope x: origin + t ray meets it at t, which is the camera's z.
        t = (distance + slope * camera.position[0] - camera.position[2]) / (rays[..., 2] - slope * rays[..., 0])
        place = camera.position + t[..., None] * rays
        nearer = (t > 0) & (t < depth) & (place[..., 0] >= left) & (place[..., 0] <= right)
        depth = np.where(nearer, t, depth)
        grey = np.where(nearer, texture(place[..., 0], place[..., 1], number), grey)
    return depth, grey


def photograph(camera: Camera, planes, points: np.ndarray) -> StereoPhoto:
    """Return a photo of planes z = distance + slope x with left <= x <= right, given as such tuples of four numbers.

    The photo shows those of `points` that lie in its picture.
    """
    _, grey = depths_of_planes(camera, planes)
    x, y, z = camera.project(points)
    shown = np.flatnonzero(camera.in_picture(x, y, z))
    return StereoPhoto(camera, grey.astype(np.float32), np.ones(grey.shape, bool), shown)

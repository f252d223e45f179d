"""Synthetic photos of a corner of a room, with known poses and textured walls that give many features."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from hyrfpack.cameras.paths import look_at

PHOTO_SIZE = (200, 150)
FOCAL_PIXELS = 175.0
_TEXELS_PER_UNIT = 90


def wall_textures(seed: int = 0) -> np.ndarray:
    """Return (3, 512, 512, 3) uint8 textures of the planes x = 0, y = 0, z = 0: random patches of many sizes."""
    rng = np.random.default_rng(seed)
    textures = np.full((3, 512, 512, 3), 128.0)
    for texture in textures:
        for side in (64, 24, 10, 5):
            for _ in range(40_000 // side**2):
                row, column = rng.integers(0, 512 - side, 2)
                texture[row : row + side, column : column + side] = rng.uniform(20, 235, 3)
    return textures.astype(np.uint8)


def arc_pose(share: float, height: float = 2.2, far: float = 4.0) -> np.ndarray:
    """Return a (3, 4) camera_from_world on an arc before the corner; `share` is 0 at one wall and 1 at the other."""
    angle = np.radians(20 + 50 * share)
    position = np.array([1 + far * np.cos(angle), 1 + far * np.sin(angle), height])
    return look_at(position, np.array([0.9, 0.9, 1.1]), np.array([0.0, 0.0, 1.0]))[:3]


def render_photo(
    pose: np.ndarray, textures: np.ndarray, size: tuple[int, int] = PHOTO_SIZE, focal: float = FOCAL_PIXELS
) -> np.ndarray:
    """Render what a pinhole camera sees, as (H, W, 3) uint8."""
    width, height = size
    x, y = np.meshgrid((np.arange(width) + 0.5 - width / 2) / focal, (np.arange(height) + 0.5 - height / 2) / focal)
    return _trace_rays(pose, np.stack([x, y, np.ones_like(x)], -1), textures)


def render_panorama(pose: np.ndarray, textures: np.ndarray, height: int = 256, finer: int = 4) -> np.ndarray:
    """Render an equirectangular panorama as (H, 2 H, 3) uint8, with the forward direction in the middle."""
    rows, columns = finer * height, 2 * finer * height
    longitude = ((np.arange(columns) + 0.5) / columns - 0.5) * 2 * np.pi
    latitude = ((np.arange(rows) + 0.5)[:, None] / rows - 0.5) * np.pi  # downwards
    x, z = np.sin(longitude) * np.cos(latitude), np.cos(longitude) * np.cos(latitude)
    seen = _trace_rays(pose, np.stack([x, np.broadcast_to(np.sin(latitude), x.shape), z], -1), textures)
    return np.asarray(Image.fromarray(seen).resize((2 * height, height), Image.Resampling.BOX))


def _trace_rays(pose: np.ndarray, directions: np.ndarray, textures: np.ndarray) -> np.ndarray:
    """Return the (H, W, 3) colours along (H, W, 3) rays in camera axes."""
    rays = directions @ pose[:, :3]
    origin = -pose[:, :3].T @ pose[:, 3]
    seen = np.zeros(rays.shape, np.uint8)
    nearest = np.full(rays.shape[:2], np.inf)
    for axis in range(3):
        with np.errstate(divide="ignore"):
            distance = -origin[axis] / rays[..., axis]
        points = origin + rays * distance[..., None]
        u, v = (np.delete(points, axis, axis=-1) * _TEXELS_PER_UNIT).astype(np.int64).transpose(2, 0, 1)
        hit = (distance > 0) & (distance < nearest) & (u >= 0) & (v >= 0) & (u < 512) & (v < 512)
        nearest[hit] = distance[hit]
        seen[hit] = textures[axis][u[hit], v[hit]]
    return seen


def write_photos(folder: Path, count: int = 8) -> dict[str, np.ndarray]:
    """Write `count` photos along the arc and return their poses by file name."""
    folder.mkdir(parents=True, exist_ok=True)
    textures, poses = wall_textures(), {}
    for number in range(count):
        name = f"photo{number:02d}.png"
        poses[name] = arc_pose(number / max(count - 1, 1), 2.2 + 0.4 * np.sin(2.3 * number))
        large = render_photo(poses[name], textures, (2 * PHOTO_SIZE[0], 2 * PHOTO_SIZE[1]), 2 * FOCAL_PIXELS)
        Image.fromarray(large).resize(PHOTO_SIZE, Image.Resampling.BOX).save(folder / name)
    return poses

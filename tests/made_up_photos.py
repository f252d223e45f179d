"""Photos of the corner of a room whose walls are full of texture: many features, known poses, made in milliseconds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from hyrfpack.cameras.paths import look_at

SIZE, FOCAL = (200, 150), 175.0  # of the photos, in pixels
_TEXELS = 90  # of a texture to the unit of length


def walls(seed: int = 0) -> np.ndarray:
    """(3, 512, 512, 3) uint8 textures of the planes x = 0, y = 0, z = 0: random patches of many sizes."""
    rng = np.random.default_rng(seed)
    textures = np.full((3, 512, 512, 3), 128.0)
    for texture in textures:
        for side in (64, 24, 10, 5):
            for _ in range(40_000 // side**2):
                row, column = rng.integers(0, 512 - side, 2)
                texture[row : row + side, column : column + side] = rng.uniform(20, 235, 3)
    return textures.astype(np.uint8)


def place(share: float, height: float = 2.2, far: float = 4.0) -> np.ndarray:
    """(3, 4) camera_from_world on an arc before the corner, from one wall (0) to the other (1)."""
    angle = np.radians(20 + 50 * share)
    position = np.array([1 + far * np.cos(angle), 1 + far * np.sin(angle), height])
    return look_at(position, np.array([0.9, 0.9, 1.1]), np.array([0.0, 0.0, 1.0]))[:3]


def picture(pose: np.ndarray, textures: np.ndarray, size: tuple[int, int] = SIZE, focal: float = FOCAL) -> np.ndarray:
    """(H, W, 3) uint8, what a camera sees."""
    width, height = size
    x, y = np.meshgrid((np.arange(width) + 0.5 - width / 2) / focal, (np.arange(height) + 0.5 - height / 2) / focal)
    return _seen(pose, np.stack([x, y, np.ones_like(x)], -1), textures)


def panorama(pose: np.ndarray, textures: np.ndarray, height: int = 256, finer: int = 4) -> np.ndarray:
    """(H, 2 H, 3) uint8, what is all around a camera, equirectangular, its forward direction in the middle."""
    rows, columns = finer * height, 2 * finer * height
    longitude = ((np.arange(columns) + 0.5) / columns - 0.5) * 2 * np.pi
    latitude = ((np.arange(rows) + 0.5)[:, None] / rows - 0.5) * np.pi  # downwards
    x, z = np.sin(longitude) * np.cos(latitude), np.cos(longitude) * np.cos(latitude)
    seen = _seen(pose, np.stack([x, np.broadcast_to(np.sin(latitude), x.shape), z], -1), textures)
    return np.asarray(Image.fromarray(seen).resize((2 * height, height), Image.Resampling.BOX))


def _seen(pose: np.ndarray, directions: np.ndarray, textures: np.ndarray) -> np.ndarray:
    """Colours along (H, W, 3) rays in the camera's axes."""
    rays = directions @ pose[:, :3]
    origin = -pose[:, :3].T @ pose[:, 3]
    seen = np.zeros(rays.shape, np.uint8)
    nearest = np.full(rays.shape[:2], np.inf)
    for axis in range(3):
        with np.errstate(divide="ignore"):
            distance = -origin[axis] / rays[..., axis]
        points = origin + rays * distance[..., None]
        u, v = (np.delete(points, axis, axis=-1) * _TEXELS).astype(np.int64).transpose(2, 0, 1)
        hit = (distance > 0) & (distance < nearest) & (u >= 0) & (v >= 0) & (u < 512) & (v < 512)
        nearest[hit] = distance[hit]
        seen[hit] = textures[axis][u[hit], v[hit]]
    return seen


def write_photos(folder: Path, count: int = 8) -> dict[str, np.ndarray]:
    """Write photos along the arc; returns the pose of each by name."""
    folder.mkdir(parents=True, exist_ok=True)
    textures, poses = walls(), {}
    for number in range(count):
        name = f"photo{number:02d}.png"
        poses[name] = place(number / max(count - 1, 1), 2.2 + 0.4 * np.sin(2.3 * number))
        large = picture(poses[name], textures, (2 * SIZE[0], 2 * SIZE[1]), 2 * FOCAL)
        Image.fromarray(large).resize(SIZE, Image.Resampling.BOX).save(folder / name)
    return poses

"""A procedural scene for demonstrations and tests, drawn by ray casting and written as a nerfstudio folder.

Glossy and textured spheres and boxes stand on a paved disc under a sky with sun and clouds. World units are about
metres, z up. Vectors are (3, N) float32, so that each component is contiguous.
"""

from __future__ import annotations

import io
import json
import math
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hyrfpack.atomic import write_atomic
from hyrfpack.cameras.paths import look_at
from hyrfpack.errors import needs_package
from hyrfpack.ply import encode_colored_points

NO_HIT_DISTANCE = np.float32(1e9)
_SUN_DIRECTION = np.array([0.45, -0.55, 0.70]) / np.linalg.norm([0.45, -0.55, 0.70])
_SUN_COLOR = np.array([[1.0], [0.90], [0.74]], np.float32) * 2.1
_SUN_HALF_WIDTH_RADIANS = 0.012  # each subsample of a pixel sees another corner of the sun, which softens shadows
_HORIZON_COLOR = np.array([[0.66], [0.78], [0.92]], np.float32)
_ZENITH_COLOR = np.array([[0.07], [0.21], [0.58]], np.float32)
_SUBSAMPLES_PER_PIXEL_SIDE = 2  # each pixel has four rays
_FOCAL_LENGTH_PICTURE_WIDTHS = 1.1  # gives a field of view of 49 degrees
_SPARSE_POINT_COUNT = 4000

# A function of surface coordinates (2, N) and the noise tile that returns the albedo (3, N).
Texture = Callable[[np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Solid:
    """A sphere (`box` False, half-extents equal) or a box that is rotated by `yaw` about z."""

    center: tuple[float, float, float]
    half: tuple[float, float, float]
    texture: Texture
    box: bool = False
    yaw: float = 0.0
    reflectance: float = 0.0  # share of light that is mirrored at normal incidence, in [0, 1]
    metal: bool = False  # a metal mirrors light in the colour of its albedo and scatters none

    @property
    def object_from_world(self) -> np.ndarray:
        """The (3, 3) rotation from world axes to object axes."""
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        return np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]], np.float32)


def write_demo_scene(
    folder: str | os.PathLike[str], *, views: int = 60, size: int = 200, seed: int = 0, overwrite: bool = True
) -> Path:
    """Write a procedural scene that `load_scene` reads: pictures, transforms.json and a sparse point cloud.

    Args:
        folder: folder of the scene; created if missing.
        views: number of pictures, taken from a dome around the objects.
        size: width and height of a picture in pixels.
        seed: random seed of textures, cameras and points; the same seed writes the same bytes.
        overwrite: replace existing files; without it, they are an error.

    Returns:
        The folder.

    Raises:
        ValueError: fewer than two views or a size below 8.
        HyrfError: the folder or a file cannot be written.
    """
    with needs_package("making photos"):
        from PIL import Image

    if views < 2 or size < 8:
        raise ValueError(f"a scene needs 2 views of 8 pixels or more, not {views} of {size}")
    folder = Path(folder)
    rng = np.random.default_rng(seed)
    noise = _noise_tile(rng)
    frames, points, colors = [], [], []
    per_view = -(-_SPARSE_POINT_COUNT // views)
    for index in range(views):
        world_from_camera, focal = _place_camera(index, views, size, rng)
        picture, surface = _render(world_from_camera, focal, size, noise)
        photo = io.BytesIO()
        Image.fromarray(picture).save(photo, format="png")
        path = folder / "images" / f"{index:04d}.png"
        write_atomic(path, photo.getbuffer(), overwrite=overwrite, rename=False)
        frames.append(
            {
                "file_path": f"images/{index:04d}.png",
                "w": size,
                "h": size,
                "fl_x": focal,
                "fl_y": focal,
                "cx": size / 2,
                "cy": size / 2,
                # The format has OpenGL's camera axes: the camera looks along -z, and y is up.
                "transform_matrix": (world_from_camera * (1, -1, -1, 1)).tolist(),
            }
        )
        rows, columns = rng.integers(0, size, (2, per_view))
        depth = np.linalg.norm(surface[:, rows, columns] - world_from_camera[:3, 3:], axis=0)
        near = depth < 15
        exact = surface[:, rows, columns].T[near]
        points.append(exact + rng.normal(size=exact.shape) * 0.002 * depth[near, None])
        colors.append(picture[rows, columns][near])
    cloud = encode_colored_points(np.concatenate(points), np.concatenate(colors))
    write_atomic(folder / "sparse_pc.ply", cloud, overwrite=overwrite, rename=False)
    content = {"camera_model": "PINHOLE", "ply_file_path": "sparse_pc.ply", "frames": frames}
    poses = json.dumps(content, indent=1).encode()
    write_atomic(folder / "transforms.json", poses, overwrite=overwrite, rename=False)
    return folder


def _place_camera(index: int, views: int, size: int, rng: np.random.Generator) -> tuple[np.ndarray, float]:
    """Return the (4, 4) OpenCV world_from_camera of a view and its focal length in pixels."""
    azimuth = index * math.pi * (3 - math.sqrt(5))  # with the golden angle, any subset of the views surrounds the scene
    elevation = math.radians(12 + 38 * (index + 0.5) / views)
    radius = 3.6 + rng.uniform(-0.35, 0.35)
    ring = math.cos(elevation)
    position = radius * np.array([ring * math.cos(azimuth), ring * math.sin(azimuth), math.sin(elevation)])
    target = np.array([0, 0, 0.4]) + rng.uniform(-0.12, 0.12, 3)
    pose = np.eye(4)
    pose[:3] = np.stack([*look_at(position, target, np.array([0.0, 0.0, 1.0]))[:3, :3], position], axis=1)
    return pose, size * _FOCAL_LENGTH_PICTURE_WIDTHS * rng.uniform(0.97, 1.03)


def _render(world_from_camera: np.ndarray, focal: float, size: int, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the (size, size, 3) uint8 picture and the (3, size, size) mean of the surface points of each pixel."""
    per_side = _SUBSAMPLES_PER_PIXEL_SIDE
    grid = (np.arange(size * per_side) + 0.5) / per_side
    x, y = np.meshgrid((grid - size / 2) / focal, (grid - size / 2) / focal)
    rays = world_from_camera[:3, :3] @ np.stack([x.ravel(), y.ravel(), np.ones(x.size)])
    directions = (rays / np.linalg.norm(rays, axis=0)).astype(np.float32)
    origins = np.broadcast_to(world_from_camera[:3, 3:].astype(np.float32), directions.shape)
    corner = np.indices((size * per_side, size * per_side)).reshape(2, -1) % per_side * 2 - 1
    sun = _SUN_DIRECTION[:, None] + _SUN_HALF_WIDTH_RADIANS * np.stack([corner[0], corner[1], 0 * corner[0]])
    color, distance = _radiance(origins, directions, (sun / np.linalg.norm(sun, axis=0)).astype(np.float32), noise, 1)
    blocks = color.reshape(3, size, per_side, size, per_side).mean(axis=(2, 4))
    surface = (origins + directions * distance).reshape(3, size, per_side, size, per_side).mean(axis=(2, 4))
    shown = np.clip(1 - np.exp(-0.80 * blocks), 0, 1) ** (1 / 2.2)  # the curve of film keeps highlights in range
    return (shown.transpose(1, 2, 0) * 255 + 0.5).astype(np.uint8), surface


def _radiance(
    origins: np.ndarray, directions: np.ndarray, sun: np.ndarray, noise: np.ndarray, bounces: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the linear light (3, N) along each ray, and the distance (N,) to the surface that it comes from."""
    distance, hit = find_nearest_hit(origins, directions)
    color = np.empty_like(directions)
    sky = hit < 0
    color[:, sky] = _sky_color(directions[:, sky], noise)
    for index in range(len(SOLID_SHAPES) + 1):
        rays = np.flatnonzero(hit == index)
        if rays.size:
            points = origins[:, rays] + directions[:, rays] * distance[rays]
            color[:, rays] = _shade(index, points, directions[:, rays], sun[:, rays], distance[rays], noise, bounces)
    return color, distance


def _shade(
    index: int,
    points: np.ndarray,
    directions: np.ndarray,
    sun: np.ndarray,
    distance: np.ndarray,
    noise: np.ndarray,
    bounces: int,
) -> np.ndarray:
    """Return the linear light (3, N) from points of one surface, whose index is that of `find_nearest_hit`."""
    if index == len(SOLID_SHAPES):
        normals = np.broadcast_to(np.array([[0], [0], [1]], np.float32), points.shape)
        albedo, reflectance, metal = _ground_albedo(points, distance, noise), 0.0, False
    else:
        solid = SOLID_SHAPES[index]
        normals, coordinates = _normals_and_coordinates(solid, points)
        albedo, reflectance, metal = solid.texture(coordinates, noise), solid.reflectance, solid.metal
    lifted = points + normals * np.float32(2e-3)
    facing = np.maximum(_dot(normals, sun), 0)
    lit = facing > 0
    lit[lit] = ~_is_blocked(lifted[:, lit], sun[:, lit])
    ambient = (
        (0.24 + 0.20 * normals[2])
        * _open_sky_share(points, normals, index)
        * (0.4 * _HORIZON_COLOR + 0.8 * _ZENITH_COLOR + 0.1)
    )
    color = albedo * (ambient + _SUN_COLOR * (facing * lit)) * np.float32(0 if metal else 1)
    if reflectance or metal:
        cosine = -_dot(directions, normals)
        mirrored = directions + 2 * cosine * normals
        face_on = albedo if metal else np.float32(reflectance)
        fresnel = face_on + (1 - face_on) * 0.9 * np.clip(1 - cosine, 0, 1) ** 5  # Schlick's approximation
        seen = _radiance(lifted, mirrored, sun, noise, bounces - 1)[0] if bounces else _sky_color(mirrored, noise)
        glint = 3.0 * lit * np.maximum(_dot(mirrored, sun), 0) ** 180  # Phong's highlight
        color = color * (1 - fresnel) + seen * fresnel + glint * (fresnel + 0.2)
    haze = np.exp(-distance / 90)
    return color * haze + _HORIZON_COLOR * (1 - haze)


def _sky_color(directions: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Return the linear light (3, N) of sky, sun and clouds."""
    height = np.maximum(directions[2], 0)
    color = _ZENITH_COLOR + (_HORIZON_COLOR - _ZENITH_COLOR) * np.exp(-4.5 * height)
    plane = directions[:2] / (height + 0.16)  # clouds lie on a plane overhead
    density = np.clip((_sample_noise(noise, plane * 0.09 + 0.3) - 0.50) * 4.5, 0, 1) * np.clip(height * 7, 0, 1)
    shade = 0.82 + 0.35 * _sample_noise(noise, plane * 0.21)
    color += (np.array([[1.15], [1.13], [1.12]], np.float32) * shade - color) * density * 0.9
    toward = np.maximum(_SUN_DIRECTION.astype(np.float32) @ directions, 0)
    return color + _SUN_COLOR * (0.12 * toward**12 + 0.35 * toward**120 + 6 * (toward > math.cos(0.035)))


def find_nearest_hit(origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distance to the nearest surface and its index, which is the number of solids for the ground.

    Rays that hit the sky have index -1 and the distance NO_HIT_DISTANCE.
    """
    down = directions[2] < -1e-6
    distance = np.where(down, -origins[2] / np.where(down, directions[2], -1), NO_HIT_DISTANCE)
    hit = np.where(down, len(SOLID_SHAPES), -1)
    for index, solid in enumerate(SOLID_SHAPES):
        near = _intersect(solid, origins, directions)
        closer = near < distance
        distance[closer], hit[closer] = near[closer], index
    return distance, hit


def _is_blocked(origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return whether a solid lies on each ray."""
    blocked = np.zeros(origins.shape[1], bool)
    for solid in SOLID_SHAPES:
        blocked |= _intersect(solid, origins, directions) < NO_HIT_DISTANCE
    return blocked


def _intersect(solid: Solid, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return the distance (N,) along unit rays to the front of a solid, NO_HIT_DISTANCE where they miss it."""
    center = np.array(solid.center, np.float32)[:, None]
    start = origins - center
    middle = -_dot(start, directions)
    offset = _dot(start, start) - middle * middle  # squared distance of the ray from the centre
    result = np.full(origins.shape[1], NO_HIT_DISTANCE)
    bound = solid.half[0] if not solid.box else math.hypot(*solid.half)
    near = np.flatnonzero((offset < bound * bound) & (middle > -bound))
    if not solid.box:
        entry = middle[near] - np.sqrt(bound * bound - offset[near])
        result[near] = np.where(entry > 1e-4, entry, NO_HIT_DISTANCE)
        return result
    start, along = solid.object_from_world @ start[:, near], solid.object_from_world @ directions[:, near]
    inverse = 1 / np.where(np.abs(along) < 1e-7, np.float32(1e-7), along)
    half = np.array(solid.half, np.float32)[:, None]
    first, second = (-half - start) * inverse, (half - start) * inverse
    entry = np.minimum(first, second).max(axis=0)
    leave = np.maximum(first, second).min(axis=0)
    result[near] = np.where((entry < leave) & (entry > 1e-4), entry, NO_HIT_DISTANCE)
    return result


def _normals_and_coordinates(solid: Solid, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return outward normals (3, N) in the world, and surface coordinates (2, N) in world units."""
    local = solid.object_from_world @ (points - np.array(solid.center, np.float32)[:, None])
    if not solid.box:
        normals = local / solid.half[0]
        coordinates = solid.half[0] * np.stack(
            [np.arctan2(normals[1], normals[0]), np.arcsin(np.clip(normals[2], -1, 1))]
        )
        return solid.object_from_world.T @ normals, coordinates
    axis = np.abs(local / np.array(solid.half, np.float32)[:, None]).argmax(axis=0)
    normals = np.zeros_like(local)
    column = np.arange(local.shape[1])
    normals[axis, column] = np.sign(local[axis, column])
    coordinates = np.stack([local[np.where(axis == 0, 1, 0), column], local[np.where(axis == 2, 1, 2), column]])
    return solid.object_from_world.T @ normals, coordinates


def _open_sky_share(points: np.ndarray, normals: np.ndarray, index: int) -> np.ndarray:
    """Return the share (N,) of the sky that the other solids leave open, each approximated by a sphere."""
    free = np.ones(points.shape[1], np.float32)
    for other, solid in enumerate(SOLID_SHAPES):
        if other != index:
            toward = np.array(solid.center, np.float32)[:, None] - points
            squared = np.maximum(_dot(toward, toward), 1e-4)
            facing = np.maximum(_dot(toward, normals), 0) / np.sqrt(squared)
            free *= 1 - np.minimum(facing * np.mean(solid.half) ** 2 / squared, 0.85)
    return free


def _noise_tile(rng: np.random.Generator, size: int = 256) -> np.ndarray:
    """Return a periodic tile (size, size) of cloud-like noise in [0, 1]: white noise, filtered by f^-1.6."""
    frequency = np.hypot(np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)[None, :])
    frequency[0, 0] = np.inf
    tile = np.fft.irfft2(np.fft.rfft2(rng.normal(size=(size, size))) * frequency**-1.6, s=(size, size))
    return (np.argsort(np.argsort(tile.ravel())) / tile.size).reshape(size, size).astype(np.float32)


def _sample_noise(noise: np.ndarray, coordinates: np.ndarray) -> np.ndarray:
    """Sample the tile bilinearly at (2, N) coordinates, whose unit is the tile and which wrap around."""
    size = len(noise)
    scaled = coordinates * size
    corner = np.floor(scaled)
    u, v = scaled - corner
    x0, y0 = corner.astype(np.int32) & (size - 1)  # this wraps, because the size is a power of two
    x1, y1 = (x0 + 1) & (size - 1), (y0 + 1) & (size - 1)
    return (noise[y0, x0] * (1 - u) + noise[y0, x1] * u) * (1 - v) + (noise[y1, x0] * (1 - u) + noise[y1, x1] * u) * v


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("in,in->n", a, b)


def _interpolate_colors(first: tuple, second: tuple, share: np.ndarray) -> np.ndarray:
    a, b = np.array(first, np.float32)[:, None], np.array(second, np.float32)[:, None]
    return a + (b - a) * share


def _checkerboard(coordinates: np.ndarray, side: float) -> np.ndarray:
    return (np.floor(coordinates / side).sum(axis=0) % 2).astype(np.float32)


def _ground_albedo(points: np.ndarray, distance: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Return the albedo (3, N) of the ground: paving in a disc, a stone rim, and meadow outside.

    Fine detail fades with distance, as a lens would show it.
    """
    flat = points[:2]
    fade = np.exp(-distance / 14)
    grain = (_sample_noise(noise, flat * 0.9) - 0.5) * fade
    meadow = _interpolate_colors(
        (0.10, 0.19, 0.04), (0.36, 0.31, 0.12), 0.5 + (_sample_noise(noise, flat * 0.11) - 0.5) * (0.4 + fade)
    )
    meadow = meadow * (1 + 0.9 * grain)
    paving = _interpolate_colors(
        (0.50, 0.37, 0.25), (0.15, 0.18, 0.24), 0.5 + (_checkerboard(flat, 0.4) - 0.5) * fade
    ) * (1 + 0.8 * grain)
    rim = _interpolate_colors((0.42, 0.40, 0.38), (0.60, 0.58, 0.54), _sample_noise(noise, flat * 0.5))
    radius = np.hypot(*flat)
    return np.where(radius < 1.9, paving, np.where(radius < 2.05, rim, meadow))


def _uniform_color(color: tuple) -> Texture:
    return lambda coordinates, noise: np.broadcast_to(np.array(color, np.float32)[:, None], (3, coordinates.shape[1]))


def _wood(coordinates: np.ndarray, noise: np.ndarray) -> np.ndarray:
    rings = coordinates[0] * 9 + 2.2 * _sample_noise(noise, coordinates * np.array([[0.6], [0.15]], np.float32))
    return _interpolate_colors((0.50, 0.27, 0.11), (0.23, 0.10, 0.04), (rings % 1) ** 2)


def _marble(coordinates: np.ndarray, noise: np.ndarray) -> np.ndarray:
    veins = np.abs(np.sin(coordinates[1] * 6 + 11 * _sample_noise(noise, coordinates * 0.35)))
    return _interpolate_colors((0.10, 0.16, 0.24), (0.86, 0.85, 0.80), veins**0.45)


def _tiles(coordinates: np.ndarray, noise: np.ndarray) -> np.ndarray:
    grain = 0.75 + 0.5 * _sample_noise(noise, coordinates * 0.8)
    return _interpolate_colors((0.85, 0.62, 0.10), (0.06, 0.22, 0.38), _checkerboard(coordinates + 0.01, 0.11)) * grain


def _stripes(coordinates: np.ndarray, noise: np.ndarray) -> np.ndarray:
    return _interpolate_colors(
        (0.75, 0.74, 0.70), (0.04, 0.34, 0.36), ((coordinates[1] * 7) % 1 > 0.5).astype(np.float32)
    )


SOLID_SHAPES = (
    Solid((-0.72, -0.28, 0.5), (0.5, 0.5, 0.5), _uniform_color((0.50, 0.015, 0.02)), reflectance=0.07),
    Solid((0.42, -0.78, 0.36), (0.36, 0.36, 0.36), _uniform_color((0.95, 0.60, 0.18)), metal=True),
    Solid((0.48, 0.48, 0.45), (0.27, 0.27, 0.45), _wood, box=True, yaw=0.5),
    Solid((0.48, 0.48, 1.12), (0.22, 0.22, 0.22), _stripes, reflectance=0.05),
    Solid((-0.38, 0.82, 0.32), (0.32, 0.32, 0.32), _marble, reflectance=0.04),
    Solid((1.18, -0.12, 0.16), (0.22, 0.16, 0.16), _tiles, box=True, yaw=-0.4),
    Solid((-0.30, -1.20, 0.17), (0.17, 0.17, 0.17), _tiles, box=True, yaw=0.9),
)

"""Photos and depth maps of a scene.

Each pixel has 2 x 2 subsamples. Rays through the corners of a pixel show whether one surface fills it and whether a
shadow's edge crosses it. Only pixels with several surfaces search for the surface of each subsample, and only those
with several surfaces or a shadow's edge cast further rays to the sun, to different places on its disc.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from hyrfpack.parallel.pool import run_tasks
from hyrfpack.scene import Camera
from tools.scenes.geometry import SceneArrays, describe_surface, find_nearest_hit, hit_primitive, is_blocked
from tools.scenes.noise import inlined_kernel, kernel
from tools.scenes.shading import sees_sun, shade
from tools.scenes.sky import evaluate_sky

_ROWS_PER_TASK = 16
_FOOTPRINT_SUBSAMPLES = 1.4  # side of the square that a subsample averages, in distances of subsamples
_DISPLAY_GAMMA = 1 / 2.2
_TONE_CONTRAST = 0.55


class CameraArrays(NamedTuple):
    """A camera as compiled code takes it.

    Attributes:
        axes: (3, 3) world_from_camera rotation.
        position: (3,) in the world.
        intrinsics: (4,) fx, fy, cx, cy in pixels.
    """

    axes: np.ndarray
    position: np.ndarray
    intrinsics: np.ndarray


def make_camera_arrays(camera: Camera) -> CameraArrays:
    """Convert a camera for compiled code."""
    return CameraArrays(
        np.ascontiguousarray(camera.rotation.T),
        np.ascontiguousarray(camera.position),
        np.array(camera.intrinsics, np.float64),
    )


@inlined_kernel
def _ray_direction(camera, x, y):
    """Return the unit direction in the world of the ray through a point of the picture, and its cosine to the axis."""
    a = (x - camera.intrinsics[2]) / camera.intrinsics[0]
    b = (y - camera.intrinsics[3]) / camera.intrinsics[1]
    norm = 1.0 / math.sqrt(a * a + b * b + 1.0)
    axes = camera.axes
    return (
        (axes[0, 0] * a + axes[0, 1] * b + axes[0, 2]) * norm,
        (axes[1, 0] * a + axes[1, 1] * b + axes[1, 2]) * norm,
        (axes[2, 0] * a + axes[2, 1] * b + axes[2, 2]) * norm,
        norm,
    )


@kernel
def _cast_corner(scene, camera, column, row):
    """Return the primitive at a pixel's corner (-1 for the sky), a code of its face, and whether the sun lights it."""
    ox, oy, oz = camera.position[0], camera.position[1], camera.position[2]
    dx, dy, dz, _ = _ray_direction(camera, float(column), float(row))
    t, i = find_nearest_hit(scene, ox, oy, oz, dx, dy, dz)
    if i < 0:
        return -1, -1, 0
    x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
    nx, ny, nz, face, _, _, _, _ = describe_surface(scene, i, x, y, z)
    across, up = (0.95 if column % 2 else -0.95), (0.95 if row % 2 else -0.95)
    return i, i * 8 + face, 1 if sees_sun(scene, x, y, z, nx, ny, nz, across, up) else 0


@kernel
def _develop(light):
    """Apply the rest of the tone curve to light in [0, 1]: gamma and some contrast."""
    shown = light**_DISPLAY_GAMMA
    return shown + _TONE_CONTRAST * (shown * shown * (3.0 - 2.0 * shown) - shown)


@kernel
def _render_rows(scene, camera, first_row, last_row, exposure, picture):
    """Write display-referred rows of a (H, W, 3) picture."""
    width = picture.shape[1]
    ox, oy, oz = camera.position[0], camera.position[1], camera.position[2]
    pixel = 1.0 / camera.intrinsics[0]
    upper, lower = np.empty((width + 1, 3), np.int64), np.empty((width + 1, 3), np.int64)
    for column in range(width + 1):
        lower[column] = _cast_corner(scene, camera, column, first_row)
    for row in range(first_row, last_row):
        upper, lower = lower, upper
        for column in range(width + 1):
            lower[column] = _cast_corner(scene, camera, column, row + 1)
        for column in range(width):
            code = upper[column, 1]
            is_uniform = code == upper[column + 1, 1] and code == lower[column, 1] and code == lower[column + 1, 1]
            lit = upper[column, 2] + upper[column + 1, 2] + lower[column, 2] + lower[column + 1, 2]
            red, green, blue = 0.0, 0.0, 0.0
            for sub in range(4):
                px, py = column + 0.25 + 0.5 * (sub % 2), row + 0.25 + 0.5 * (sub // 2)
                dx, dy, dz, cosine = _ray_direction(camera, px, py)
                t, i = np.inf, -1
                if not is_uniform:
                    t, i = find_nearest_hit(scene, ox, oy, oz, dx, dy, dz)
                elif code >= 0:
                    i = upper[column, 0]
                    t = hit_primitive(scene, i, ox, oy, oz, dx, dy, dz)
                if t == np.inf:
                    r, g, b = evaluate_sky(scene.sky, dx, dy, dz, True)
                else:
                    sunlit = 0.25 * lit
                    if not is_uniform or 0 < lit < 4:
                        x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
                        nx, ny, nz, _, _, _, _, _ = describe_surface(scene, i, x, y, z)
                        rays = 4 if is_uniform else 1
                        sunlit = 0.0
                        for ray in range(rays):
                            across = -0.75 + 0.5 * (ray if is_uniform else (2 * sub + 1 + sub // 2) % 4)
                            up = -0.75 + 0.5 * sub
                            if sees_sun(scene, x, y, z, nx, ny, nz, across, up):
                                sunlit += 1.0 / rays
                    spread = 0.5 * _FOOTPRINT_SUBSAMPLES * pixel * cosine
                    faint_weight = 1.0
                    if is_uniform:
                        faint_weight = 4.0 if sub == (column + 2 * row) % 4 else 0.0
                    r, g, b = shade(scene, i, ox, oy, oz, dx, dy, dz, t, sunlit, spread, faint_weight)
                # The shoulder comes before the average, so that edges against bright light stay smooth.
                red += 1.0 - math.exp(-exposure * r)
                green += 1.0 - math.exp(-exposure * g)
                blue += 1.0 - math.exp(-exposure * b)
            picture[row, column, 0] = _develop(0.25 * red)
            picture[row, column, 1] = _develop(0.25 * green)
            picture[row, column, 2] = _develop(0.25 * blue)


@kernel
def _depth_rows(scene, camera, first_row, last_row, depth):
    """Write rows of a (H, W) depth map."""
    ox, oy, oz = camera.position[0], camera.position[1], camera.position[2]
    for row in range(first_row, last_row):
        for column in range(depth.shape[1]):
            dx, dy, dz, cosine = _ray_direction(camera, column + 0.5, row + 0.5)
            t, _ = find_nearest_hit(scene, ox, oy, oz, dx, dy, dz)
            depth[row, column] = t * cosine


@kernel
def _cast_pixels(scene, camera, pixels, hits):
    """Write depth, primitive and outward normal of the surface at each (x, y) of `pixels` to (N, 5) `hits`."""
    ox, oy, oz = camera.position[0], camera.position[1], camera.position[2]
    for n in range(len(pixels)):
        dx, dy, dz, cosine = _ray_direction(camera, pixels[n, 0], pixels[n, 1])
        t, i = find_nearest_hit(scene, ox, oy, oz, dx, dy, dz)
        hits[n, 0], hits[n, 1] = t * cosine, i
        if i >= 0:
            nx, ny, nz, _, _, _, _, _ = describe_surface(scene, i, ox + t * dx, oy + t * dy, oz + t * dz)
            hits[n, 2], hits[n, 3], hits[n, 4] = nx, ny, nz


@kernel
def _find_visible(scene, position, points, visible):
    """Set `visible[n]` if nothing lies between a position and point n."""
    for n in range(len(points)):
        dx, dy, dz = points[n, 0] - position[0], points[n, 1] - position[1], points[n, 2] - position[2]
        t = math.sqrt(dx * dx + dy * dy + dz * dz)
        visible[n] = not is_blocked(
            scene, position[0], position[1], position[2], dx / t, dy / t, dz / t, t * (1.0 - 1e-6) - 1e-5
        )


def render_picture(scene: SceneArrays, camera: Camera, exposure: float) -> np.ndarray:
    """Return the (H, W, 3) float32 picture in [0, 1], display-referred, without the sensor's noise."""
    picture = np.empty((camera.height, camera.width, 3), np.float32)
    arrays = make_camera_arrays(camera)

    def render(first: int, last: int) -> None:
        _render_rows(scene, arrays, first, last, exposure, picture)

    _run_on_rows(render, camera.height)
    return picture


def render_depth(scene: SceneArrays, camera: Camera) -> np.ndarray:
    """Return the (H, W) float32 depth map of a photo: metres along the view axis at pixel centres, infinite in the sky.

    Args:
        scene: `SceneDescription.arrays`.
        camera: any pinhole camera outside all primitives.
    """
    depth = np.empty((camera.height, camera.width), np.float32)
    arrays = make_camera_arrays(camera)

    def render(first: int, last: int) -> None:
        _depth_rows(scene, arrays, first, last, depth)

    _run_on_rows(render, camera.height)
    return depth


def cast_pixels(scene: SceneArrays, camera: Camera, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return depth (N,), primitive (N,) and outward normal (N, 3) at (N, 2) positions in a photo.

    In the sky, the depth is infinite and the primitive -1.
    """
    hits = np.zeros((len(pixels), 5))
    _cast_pixels(scene, make_camera_arrays(camera), np.ascontiguousarray(pixels, np.float64), hits)
    return hits[:, 0], hits[:, 1].astype(np.int64), hits[:, 2:]


def find_visible(scene: SceneArrays, position: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return (N,) whether each of the (N, 3) surface points is visible from a position."""
    visible = np.empty(len(points), bool)
    _find_visible(scene, np.ascontiguousarray(position, np.float64), np.ascontiguousarray(points), visible)
    return visible


def _run_on_rows(render, height: int) -> None:
    def task(index: int) -> None:
        render(index * _ROWS_PER_TASK, min((index + 1) * _ROWS_PER_TASK, height))

    run_tasks(task, -(-height // _ROWS_PER_TASK))

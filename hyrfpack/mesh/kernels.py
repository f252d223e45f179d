"""Compiled loops over voxels and vertices that look up depth maps."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hyrfpack.mesh.depth_maps import DepthMap
from hyrfpack.parallel.compiled import compiled

_kernel = compiled(fastmath={"contract", "nsz"}, error_model="numpy")
_inlined = compiled(fastmath={"contract", "nsz"}, error_model="numpy", inline="always")


class MapArrays(NamedTuple):
    """Depth maps as kernels take them: pixels of all maps in one row.

    Attributes:
        poses: (V, 3, 4) float64 camera_from_world.
        lenses: (V, 4) float64 fx, fy, cx, cy.
        sizes: (V, 3) int64 width, height, and index of the first pixel.
        depth, weight, colors: (P,), (P,) and (P, 3), as in `DepthMap`.
    """

    poses: np.ndarray
    lenses: np.ndarray
    sizes: np.ndarray
    depth: np.ndarray
    weight: np.ndarray
    colors: np.ndarray

    @classmethod
    def pack(cls, maps: Sequence[DepthMap]) -> MapArrays:
        """Copy depth maps into rows."""
        counts = [depth_map.depth.size for depth_map in maps]
        starts = np.cumsum([0, *counts])[:-1]
        cameras = [depth_map.camera for depth_map in maps]
        return cls(
            np.stack([camera.camera_from_world[:3] for camera in cameras]),
            np.array([camera.intrinsics for camera in cameras], np.float64),
            np.array([(c.width, c.height, start) for c, start in zip(cameras, starts, strict=True)], np.int64),
            np.concatenate([depth_map.depth.ravel() for depth_map in maps]),
            np.concatenate([depth_map.weight.ravel() for depth_map in maps]),
            np.concatenate([depth_map.colors.reshape(-1, 3) for depth_map in maps]),
        )


@_inlined
def _look_up(depth, weight, width, height, start, u, v, max_jump):
    """Return depth and weight of a map at pixel coordinates (u, v); a weight of 0 where there is none.

    Depth is interpolated between the four nearest pixels if all are trusted and differ by at most `max_jump`.
    Otherwise it is the nearest pixel's.
    """
    nearest = start + min(int(v), height - 1) * width + min(int(u), width - 1)
    z, w = np.float64(depth[nearest]), np.float64(weight[nearest])
    column, row = int(math.floor(u - 0.5)), int(math.floor(v - 0.5))
    if w == 0 or column < 0 or row < 0 or column + 1 >= width or row + 1 >= height:
        return z, w
    corner = start + row * width + column
    a, b, c, d = depth[corner], depth[corner + 1], depth[corner + width], depth[corner + width + 1]
    trusted = (
        weight[corner] > 0 and weight[corner + 1] > 0 and weight[corner + width] > 0 and weight[corner + width + 1] > 0
    )
    if trusted and max(max(a, b), max(c, d)) - min(min(a, b), min(c, d)) <= max_jump:
        x, y = u - 0.5 - column, v - 0.5 - row
        z = (a * (1 - x) + b * x) * (1 - y) + (c * (1 - x) + d * x) * y
    return z, w


@_kernel
def fuse_block(low, voxel, truncation, views, poses, lenses, sizes, depth, weight, distance, total):
    """Fuse depth maps into one block of samples.

    Args:
        low: (3,) position of the first sample, world units.
        voxel: distance between samples.
        truncation: largest distance from a surface that counts, world units.
        views: indices of the maps to fuse.
        poses, lenses, sizes, depth, weight: as in `MapArrays`.
        distance: (n, n, n) float32, written: mean signed distance in truncations, in [-1, 1], positive in front.
        total: (n, n, n) float32, written: sum of weights; the distance is 1 where it is 0.
    """
    count = distance.shape[0]
    distance[:], total[:] = 0, 0
    for view in views:
        pose, (fx, fy, cx, cy), (width, height, start) = poses[view], lenses[view], sizes[view]
        step_x, step_y, step_z = pose[0, 2] * voxel, pose[1, 2] * voxel, pose[2, 2] * voxel
        for i in range(count):
            for j in range(count):
                px, py, pz = low[0] + i * voxel, low[1] + j * voxel, low[2]
                x = pose[0, 0] * px + pose[0, 1] * py + pose[0, 2] * pz + pose[0, 3]
                y = pose[1, 0] * px + pose[1, 1] * py + pose[1, 2] * pz + pose[1, 3]
                z = pose[2, 0] * px + pose[2, 1] * py + pose[2, 2] * pz + pose[2, 3]
                for k in range(count):
                    if z > 0:
                        u, v = fx * x / z + cx, fy * y / z + cy
                        if u >= 0 and v >= 0 and u < width and v < height:
                            surface, w = _look_up(depth, weight, width, height, start, u, v, truncation)
                            away = surface - z
                            if w > 0 and away >= -truncation:
                                distance[i, j, k] += np.float32(w * min(away / truncation, 1.0))
                                total[i, j, k] += np.float32(w)
                    x, y, z = x + step_x, y + step_y, z + step_z
    for i in range(count):
        for j in range(count):
            for k in range(count):
                w = total[i, j, k]
                distance[i, j, k] = distance[i, j, k] / w if w > 0 else np.float32(1)


@_kernel
def color_points(first, last, points, tolerance, poses, lenses, sizes, depth, weight, colors, result):
    """Average the colours of points first to last over the maps that see them.

    Args:
        points: (N, 3) float64, world units.
        tolerance: largest difference between a point's depth and that of the map that sees it, world units.
        result: (N, 4) float32, written: weighted sums of red, green and blue, and of the weights.
    """
    for point in range(first, last):
        px, py, pz = points[point]
        red = green = blue = total = 0.0
        for view in range(len(poses)):
            pose, (fx, fy, cx, cy), (width, height, start) = poses[view], lenses[view], sizes[view]
            x = pose[0, 0] * px + pose[0, 1] * py + pose[0, 2] * pz + pose[0, 3]
            y = pose[1, 0] * px + pose[1, 1] * py + pose[1, 2] * pz + pose[1, 3]
            z = pose[2, 0] * px + pose[2, 1] * py + pose[2, 2] * pz + pose[2, 3]
            if not z > 0:
                continue
            u, v = fx * x / z + cx, fy * y / z + cy
            if not (u >= 0 and v >= 0 and u < width and v < height):
                continue
            surface, w = _look_up(depth, weight, width, height, start, u, v, tolerance)
            if w > 0 and abs(surface - z) <= tolerance:
                w *= fx / z * (fx / z)
                pixel = start + int(v) * width + int(u)
                red += w * colors[pixel, 0]
                green += w * colors[pixel, 1]
                blue += w * colors[pixel, 2]
                total += w
        result[point, 0], result[point, 1], result[point, 2], result[point, 3] = red, green, blue, total

"""Sparse points with tracks, as structure from motion would find them, from the true geometry.

Points are surface points at corners of the photos. A photo observes a point if it lies in the photo, is not occluded
and is seen from a similar direction and distance; a detector still misses some of these. Observations have noise, and
the points are triangulated from them, so they have the errors of real ones.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from hyrfpack.scene import Camera
from tools.scenes.geometry import SceneArrays
from tools.scenes.render import cast_pixels, find_visible

MIN_TRACK_LENGTH = 3
MAX_VIEW_ANGLE_DEGREES = 45.0
OBSERVATION_NOISE_PIXELS = 0.5
_CELLS_PER_PHOTO = 420  # At most one new point comes from each cell.
_MIN_CELL_PIXELS = 4
_MIN_CORNER_SCORE = 1e-5  # smaller eigenvalue of the structure tensor of a picture in [0, 1]
_BORDER_PIXELS = 3
_SMOOTH_RADIUS_PIXELS = 1.5  # a point's surface must go on this far in the photo
_MAX_DEPTH_STEP_RATIO = 0.03
_MIN_FACING_COSINE = 0.15
_MAX_SCALE_RATIO = 2.0  # a detector finds a feature again up to this change of its size
_DETECTION_RATE = 0.6
_MIN_TRIANGULATION_ANGLE_DEGREES = 2.0
_MAX_ERROR_PIXELS = 2.0
_REFINEMENT_ROUNDS = 4


@dataclass(frozen=True, eq=False)
class Corners:
    """Corners of one photo: (N, 2) positions in pixels and (N, 3) uint8 colours."""

    positions: np.ndarray
    colors: np.ndarray


@dataclass(frozen=True, eq=False)
class SparsePoints:
    """N points with M observations, which are sorted by point and then by photo.

    Attributes:
        positions: (N, 3) triangulated points in the world.
        colors: (N, 3) uint8.
        errors: (N,) mean reprojection error in pixels.
        point, photo: (M,) indices of the observations.
        pixels: (M, 2) observed positions.
    """

    positions: np.ndarray
    colors: np.ndarray
    errors: np.ndarray
    point: np.ndarray
    photo: np.ndarray
    pixels: np.ndarray


def find_corners(photo: np.ndarray) -> Corners:
    """Return the strongest corner of each cell of a grid over a (H, W, 3) uint8 photo (Shi-Tomasi)."""
    gray = ndimage.gaussian_filter(photo.mean(axis=2, dtype=np.float32) / 255, 1.0)
    dy, dx = np.gradient(gray)
    xx, yy, xy = (ndimage.gaussian_filter(product, 1.5) for product in (dx * dx, dy * dy, dx * dy))
    score = (xx + yy) / 2 - np.sqrt(((xx - yy) / 2) ** 2 + xy * xy)
    height, width = score.shape
    border = np.ones_like(score, bool)
    border[_BORDER_PIXELS:-_BORDER_PIXELS, _BORDER_PIXELS:-_BORDER_PIXELS] = False
    score[border] = 0
    cell = max(_MIN_CELL_PIXELS, round((width * height / _CELLS_PER_PHOTO) ** 0.5))
    positions = []
    for top in range(0, height, cell):
        for left in range(0, width, cell):
            part = score[top : top + cell, left : left + cell]
            row, column = np.unravel_index(part.argmax(), part.shape)
            if part[row, column] > _MIN_CORNER_SCORE:
                positions.append((left + column, top + row))
    places = np.array(positions, np.int64).reshape(-1, 2)
    return Corners(places + 0.5, photo[places[:, 1], places[:, 0]])


def make_sparse_points(
    scene: SceneArrays, cameras: list[Camera], corners: list[Corners], rng: np.random.Generator
) -> SparsePoints:
    """Make points at the corners of all photos, observe them with noise and triangulate them."""
    parts = [
        _find_surface_points(scene, camera, photo_corners)
        for camera, photo_corners in zip(cameras, corners, strict=True)
    ]
    exact = np.concatenate([part[0] for part in parts])
    normals = np.concatenate([part[1] for part in parts])
    colors = np.concatenate([part[2] for part in parts])
    source = np.repeat(np.arange(len(cameras)), [len(part[0]) for part in parts])
    observations = [_observe(scene, cameras, number, exact, normals, source, rng) for number in range(len(cameras))]
    point = np.concatenate([rows for rows, _ in observations])
    photo = np.repeat(np.arange(len(cameras)), [len(rows) for rows, _ in observations])
    pixels = np.concatenate([positions for _, positions in observations])
    order = np.lexsort((photo, point))
    point, photo, pixels = point[order], photo[order], pixels[order]
    count = np.bincount(point, minlength=len(exact))
    directions = _compute_directions(cameras, photo, exact[point])
    start = _compute_directions(cameras, source, exact)[point]
    angle = np.zeros(len(exact))
    np.maximum.at(angle, point, np.degrees(np.arccos(np.clip((directions * start).sum(axis=1), -1, 1))))
    keep = (count >= MIN_TRACK_LENGTH) & (angle > _MIN_TRIANGULATION_ANGLE_DEGREES)
    positions, errors = _triangulate(cameras, exact, point, photo, pixels)
    keep &= np.isfinite(errors) & (errors < _MAX_ERROR_PIXELS)
    new_number = np.cumsum(keep) - 1
    kept = keep[point]
    return SparsePoints(positions[keep], colors[keep], errors[keep], new_number[point[kept]], photo[kept], pixels[kept])


def _find_surface_points(
    scene: SceneArrays, camera: Camera, corners: Corners
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return surface points, normals and colours of those corners that lie on one smooth surface."""
    depth, primitive, normals = cast_pixels(scene, camera, corners.positions)
    keep = primitive >= 0
    r = _SMOOTH_RADIUS_PIXELS
    for shift in ((r, 0), (-r, 0), (0, r), (0, -r)):
        near = cast_pixels(scene, camera, corners.positions + shift)[0]
        with np.errstate(invalid="ignore"):  # in the sky, depths are infinite
            keep &= np.abs(near - depth) < _MAX_DEPTH_STEP_RATIO * depth
    fx, fy, cx, cy = camera.intrinsics
    local = (corners.positions - (cx, cy)) / (fx, fy)
    rays = np.concatenate([local, np.ones((len(local), 1))], axis=1)[keep] * depth[keep, None]
    return rays @ camera.rotation + camera.position, normals[keep], corners.colors[keep]


def project(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the (N, 2) pixel positions and the (N,) depths of (N, 3) points in the world."""
    local = points @ camera.rotation.T + camera.camera_from_world[:3, 3]
    fx, fy, cx, cy = camera.intrinsics
    with np.errstate(divide="ignore", invalid="ignore"):
        return local[:, :2] / local[:, 2:] * (fx, fy) + (cx, cy), local[:, 2]


def _observe(
    scene: SceneArrays,
    cameras: list[Camera],
    number: int,
    points: np.ndarray,
    normals: np.ndarray,
    source: np.ndarray,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows of the points that a photo observes, and their positions with noise."""
    camera = cameras[number]
    pixels, depth = project(camera, points)
    size = np.array([camera.width, camera.height])
    inside = (depth > 0) & ((pixels >= _BORDER_PIXELS) & (pixels < size - _BORDER_PIXELS)).all(axis=1)
    offset, first = camera.position - points, np.array([c.position for c in cameras])[source] - points
    distance, first_distance = np.linalg.norm(offset, axis=1), np.linalg.norm(first, axis=1)
    cosine = (offset * first).sum(axis=1) / (distance * first_distance)
    ratio = distance / first_distance
    similar = (cosine > np.cos(np.radians(MAX_VIEW_ANGLE_DEGREES))) & (np.abs(np.log(ratio)) < np.log(_MAX_SCALE_RATIO))
    faces = (offset * normals).sum(axis=1) > _MIN_FACING_COSINE * distance
    detected = (rng.random(len(points)) < _DETECTION_RATE) | (source == number)
    rows = np.flatnonzero(inside & similar & faces & detected)
    rows = rows[find_visible(scene, camera.position, points[rows])]
    return rows, pixels[rows] + rng.normal(size=(len(rows), 2)) * OBSERVATION_NOISE_PIXELS


def _compute_directions(cameras: list[Camera], photo: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the unit vectors (N, 3) from points to the cameras of photos."""
    offset = np.array([camera.position for camera in cameras])[photo] - points
    return offset / np.linalg.norm(offset, axis=1, keepdims=True)


def _triangulate(
    cameras: list[Camera], start: np.ndarray, point: np.ndarray, photo: np.ndarray, pixels: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the points of least squared reprojection error (by Gauss-Newton), and their mean errors in pixels."""
    rotation = np.array([camera.rotation for camera in cameras])[photo]
    shift = np.array([camera.camera_from_world[:3, 3] for camera in cameras])[photo]
    focal = np.array([camera.intrinsics[:2] for camera in cameras])[photo]
    center = np.array([camera.intrinsics[2:] for camera in cameras])[photo]
    positions = start.copy()

    def residuals() -> tuple[np.ndarray, np.ndarray]:
        local = np.einsum("nij,nj->ni", rotation, positions[point]) + shift
        return local, local[:, :2] / local[:, 2:] * focal + center - pixels

    for _ in range(_REFINEMENT_ROUNDS):
        local, error = residuals()
        scale = (focal / local[:, 2:])[..., None]
        jacobian = scale * (rotation[:, :2] - (local[:, :2] / local[:, 2:])[..., None] * rotation[:, 2:])
        normal, gradient = np.zeros((len(start), 3, 3)), np.zeros((len(start), 3))
        np.add.at(normal, point, np.einsum("nki,nkj->nij", jacobian, jacobian))
        np.add.at(gradient, point, np.einsum("nki,nk->ni", jacobian, error))
        determined = np.bincount(point, minlength=len(start)) >= 2
        trace = np.trace(normal[determined], axis1=1, axis2=2)
        normal[determined] += 1e-12 * trace[:, None, None] * np.eye(3)
        positions[determined] -= np.linalg.solve(normal[determined], gradient[determined, :, None])[..., 0]
    local, error = residuals()
    sizes = np.where(local[:, 2] > 0, np.linalg.norm(error, axis=1), np.inf)
    counts = np.bincount(point, minlength=len(start))
    return positions, np.bincount(point, sizes, minlength=len(start)) / np.maximum(counts, 1)

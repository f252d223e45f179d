"""Draw initial points on the surfaces that photos show, between and beside the points of a reconstruction.

A reconstruction finds points where photos have texture. On walls, floors and trees it has few or none.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing

import numpy as np
from scipy.spatial import Delaunay, QhullError

from hyrfpack.data.cache import PictureCache
from hyrfpack.data.reduced import reduce_camera, reduce_picture
from hyrfpack.scene import Camera, Picture, Scene, evenly_spaced
from hyrfpack.stereo import DepthMap, Photo, count_agreeing, estimate_depth_maps

MAX_PHOTOS = 100  # More photos are not read: they show the same surfaces.
# Depths are estimated from photos whose longer side has at most this many pixels.
MAX_DEPTH_MAP_PIXELS = 160
MIN_AGREEING = 1  # A depth is used if at least so many other photos see the point at the same depth.
# A triangle of points with larger ratios of depths is taken for the gap between two surfaces.
MAX_DEPTH_RATIO = 1.3


def draw_surface_points(
    scene: Scene, cache: PictureCache, count: int, generator: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Draw points at random pixels of photos whose depth is known.

    The depth of a pixel is that of a depth map (`estimate_depth_maps`) if at least MIN_AGREEING other photos agree.
    Other pixels take it from the triangle of tracked points in which they lie (`interpolate_inverse_depths`), or are
    left out, like masked and transparent ones. Points get the photo's colour.

    Args:
        scene: a scene with points. Without tracks, a photo counts as showing all points that lie in its picture.
        cache: cache of decoded photos, of which at most MAX_PHOTOS are read.
        count: number of points.
        generator: source of the random pixels.

    Returns:
        World positions (N, 3) float64 and colours (N, 3) float64 in [0, 1], where N is `count`, or 0 if no depth is
        known.

    Raises:
        HyrfDataError: a photo cannot be read.
    """
    views = evenly_spaced([view for view in scene.train if len(scene.shown_points(view))], MAX_PHOTOS)
    photos, usable = [], []
    with closing(cache.stream(views)) as pictures:
        for view, picture in pictures:
            photo, is_usable = _reduced_photo(view.camera, picture, scene.shown_points(view))
            photos.append(photo)
            usable.append(is_usable)
    maps = estimate_depth_maps(photos, scene.points)
    agreed = [_agreed_inverse_depths(maps, index, photo.grey.shape) for index, photo in enumerate(photos)]
    tracked = [scene.points[scene.tracks[view.name]] if scene.tracks else np.zeros((0, 3)) for view in views]
    known = [
        np.where(is_usable, np.where(inverse > 0, inverse, _interpolated(photo.camera, points)), 0)
        for photo, is_usable, inverse, points in zip(photos, usable, agreed, tracked, strict=True)
    ]
    shares = np.array([(inverse > 0).sum() for inverse in known], np.float64)
    if not shares.sum():
        return np.zeros((0, 3)), np.zeros((0, 3))
    drawn = generator.multinomial(count, shares / shares.sum())
    positions, colors = [], []
    with closing(cache.stream(views)) as pictures:
        for index, (view, picture) in enumerate(pictures):
            row, column = np.nonzero(known[index])
            chosen = generator.integers(len(row), size=drawn[index]) if drawn[index] else np.zeros(0, np.int64)
            row, column = row[chosen], column[chosen]
            pixels = (np.stack([column, row], 1) + generator.uniform(size=(len(row), 2))) * _reduction(view.camera)
            inverse = known[index][row, column]
            if len(tracked[index]):
                exact = interpolate_inverse_depths(view.camera, tracked[index], pixels)
                inverse = np.where((agreed[index][row, column] == 0) & (exact > 0), exact, inverse)
            positions.append(view.camera.unproject(pixels[:, 0], pixels[:, 1], 1 / inverse))
            x, y = pixels.astype(np.int64).T
            colors.append(picture.rgb[y, x] / 255)
    return np.concatenate(positions), np.concatenate(colors)


def _reduction(camera: Camera) -> int:
    """Return the factor by which a photo is reduced to estimate its depths."""
    shorter, longer = sorted((camera.width, camera.height))
    return min(-(-longer // MAX_DEPTH_MAP_PIXELS), shorter)


def _reduced_photo(camera: Camera, picture: Picture, shown: np.ndarray) -> tuple[Photo, np.ndarray]:
    """Reduce a photo to the size at which its depths are estimated.

    Args:
        camera, picture: the photo.
        shown: indices of the points that it shows.

    Returns:
        The photo in grey, black where it is transparent, and which of its pixels (H, W) are neither masked nor
        transparent.
    """
    factor = _reduction(camera)
    reduced = reduce_picture(picture, factor)
    grey = reduced.rgb.mean(-1, dtype=np.float32) / np.float32(255)
    usable = np.ones(grey.shape, bool) if reduced.mask is None else reduced.mask.copy()
    if reduced.alpha is not None:
        grey *= reduced.alpha / np.float32(255)
        usable &= reduced.alpha == 255
    return Photo(reduce_camera(camera, factor), grey, shown), usable


def _agreed_inverse_depths(maps: Sequence[DepthMap | None], index: int, shape: tuple[int, ...]) -> np.ndarray:
    """Return the inverse depths (H, W) of a depth map, 0 where too few photos agree or the depth is not finite."""
    depth_map = maps[index]
    if depth_map is None:
        return np.zeros(shape)
    enough = count_agreeing(maps, index) >= MIN_AGREEING
    return np.where(enough & (depth_map.inverse > depth_map.spacing), depth_map.inverse, 0).astype(np.float64)


def _interpolated(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Return `interpolate_inverse_depths` (H, W) at the centres of all pixels."""
    y, x = (np.mgrid[: camera.height, : camera.width] + 0.5).reshape(2, -1)
    return interpolate_inverse_depths(camera, points, np.stack([x, y], 1)).reshape(camera.height, camera.width)


def interpolate_inverse_depths(camera: Camera, points: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Interpolate inverse depths between the points that a photo shows.

    The points are connected by a Delaunay triangulation of their pixels. Within a triangle the inverse depth is linear,
    which is exact on planes. Triangles across a jump of depth are left out.

    Args:
        camera: the photo's camera.
        points: (M, 3) world positions of points that the photo shows.
        pixels: (N, 2) x and y in pixels.

    Returns:
        (N,) 1 / z in inverse world units, 0 outside all triangles.
    """
    x, y, z = camera.project(points)
    shown = (z > 0) & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
    places, inverse = np.stack([x, y], 1)[shown], 1 / z[shown]
    if len(places) < 3:
        return np.zeros(len(pixels))
    try:
        triangulation = Delaunay(places)
    except QhullError:  # all points lie in a line
        return np.zeros(len(pixels))
    triangle = triangulation.find_simplex(pixels)
    corners = inverse[triangulation.simplices[triangle]]
    transform = triangulation.transform[triangle]
    weights = np.einsum("nij,nj->ni", transform[:, :2], pixels - transform[:, 2])
    weights = np.concatenate([weights, 1 - weights.sum(1, keepdims=True)], 1)
    inside = (triangle >= 0) & (corners.max(1) < MAX_DEPTH_RATIO * corners.min(1))
    return np.where(inside, (weights * corners).sum(1), 0)

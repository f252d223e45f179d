"""Draw initial points on the surfaces that photos show, between and beside the points of a reconstruction.

A reconstruction finds points where photos have texture. On walls, floors and trees it has few or none.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace

import numpy as np
from scipy.spatial import Delaunay, QhullError

from hyrfpack.data.cache import PictureCache
from hyrfpack.data.reduced import reduce_camera, reduce_picture
from hyrfpack.parallel import has_numba
from hyrfpack.scene import Camera, Picture, Scene, evenly_spaced
from hyrfpack.stereo import InverseDepthMap, Photo, count_agreeing, estimate_depth_maps

MAX_PHOTOS = 100  # More photos are not read: they show the same surfaces.
# Without tracks, points only say which photos show the same place, and how near surfaces can be.
MAX_GUIDING_POINTS = 10_000
# Depths are estimated from photos whose longer side has at most this many pixels.
MAX_DEPTH_MAP_SIDE_PIXELS = 160
MAX_POINTS_PER_PIXEL = 4  # of a depth map, so that a few false depths do not get all points
MIN_AGREEING_PHOTOS = 1  # A depth is used if at least so many other photos see the point at the same depth.
# A triangle of points with larger ratios of depths is taken for the gap between two surfaces.
MAX_DEPTH_RATIO = 1.3


def draw_surface_points(
    scene: Scene, cache: PictureCache, count: int, generator: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Draw points at random pixels of photos whose depth is known.

    The depth of a pixel is that of a depth map (`estimate_depth_maps`) if at least MIN_AGREEING_PHOTOS other photos
    agree. Other pixels take it from the triangle of tracked points in which they lie (`interpolate_inverse_depths`), or
    are left out, like masked and transparent ones. Points get the photo's colour. Without Numba there are no depth
    maps.

    Args:
        scene: a scene with points. Without tracks, a photo counts as showing all points that lie in its picture.
        cache: cache of decoded photos, of which at most MAX_PHOTOS are read, each twice unless the cache keeps it.
        count: number of points.
        generator: source of the random pixels.

    Returns:
        World positions (N, 3) float64 and colours (N, 3) float64 in [0, 1]. N is `count`, or MAX_POINTS_PER_PIXEL times
        the number of pixels of known depth if that is less.

    Raises:
        HyrfDataError: a photo cannot be read.
    """
    if not scene.tracks and len(scene.points) > MAX_GUIDING_POINTS:
        chosen = generator.choice(len(scene.points), MAX_GUIDING_POINTS, replace=False)
        scene = replace(scene, points=scene.points[chosen], point_colors=scene.point_colors[chosen])
    shown = {view.name: scene.shown_points(view) for view in scene.train}
    views = evenly_spaced([view for view in scene.train if len(shown[view.name])], MAX_PHOTOS)
    with closing(cache.stream(views)) as pictures:
        photos = [_reduced_photo(view.camera, picture, shown[view.name]) for view, picture in pictures]
    maps = estimate_depth_maps(photos, scene.points) if has_numba() else [None] * len(photos)
    tracked = [scene.points[scene.tracks[view.name]] if scene.tracks else np.zeros((0, 3)) for view in views]
    agreed = [_agreed_inverse_depths(maps, index, photo) for index, photo in enumerate(photos)]
    known = [
        np.where(photo.usable, np.where(own > 0, own, _interpolated(photo.camera, points)), 0)
        for photo, own, points in zip(photos, agreed, tracked, strict=True)
    ]
    pixel_counts = np.array([np.count_nonzero(inverse_depths) for inverse_depths in known], np.float64)
    if not pixel_counts.sum():
        return np.zeros((0, 3)), np.zeros((0, 3))
    count = min(count, MAX_POINTS_PER_PIXEL * int(pixel_counts.sum()))
    shares = generator.multinomial(count, pixel_counts / pixel_counts.sum())
    drawn = []
    with closing(cache.stream(views)) as pictures:
        for index, (view, picture) in enumerate(pictures):
            if shares[index]:
                pixels, inverse_depths = _draw_pixels(
                    view.camera, known[index], agreed[index] > 0, tracked[index], shares[index], generator
                )
                x, y = np.minimum(pixels.astype(np.int64), (view.camera.width - 1, view.camera.height - 1)).T
                positions = view.camera.unproject(pixels[:, 0], pixels[:, 1], 1 / inverse_depths)
                drawn.append((positions, picture.rgb[y, x] / 255))
    positions, colors = (np.concatenate(parts) for parts in zip(*drawn, strict=True))
    return positions, colors


def _draw_pixels(
    camera: Camera,
    known: np.ndarray,
    is_agreed: np.ndarray,
    tracked: np.ndarray,
    count: int,
    generator: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:
    """Draw random pixels of a photo where the depth is known.

    Args:
        camera: the photo's camera.
        known: (H, W) inverse depths of the reduced photo, 0 where they are not known.
        is_agreed: (H, W) bool, where they come from the depth map; elsewhere they were interpolated.
        tracked: (M, 3) tracked points that the photo shows, between which inverse depths are interpolated again, at the
            pixels that are drawn.
        count: number of pixels.
        generator: source of random numbers.

    Returns:
        x and y in pixels (N, 2) and inverse depths (N,).
    """
    rows, columns = np.nonzero(known)
    chosen = generator.integers(len(rows), size=count)
    row, column = rows[chosen], columns[chosen]
    pixels = (np.stack([column, row], 1) + generator.uniform(size=(count, 2))) * _reduction(camera)
    inverse_depths = known[row, column]
    if len(tracked):
        interpolated = interpolate_inverse_depths(camera, tracked, pixels)
        inverse_depths = np.where(~is_agreed[row, column] & (interpolated > 0), interpolated, inverse_depths)
    return pixels, inverse_depths


def _reduction(camera: Camera) -> int:
    """Return the factor by which a photo is reduced to estimate its depths."""
    shorter, longer = sorted((camera.width, camera.height))
    return min(-(-longer // MAX_DEPTH_MAP_SIDE_PIXELS), shorter)


def _reduced_photo(camera: Camera, picture: Picture, shown: np.ndarray) -> Photo:
    """Reduce a photo to the size at which its depths are estimated; transparent pixels become black.

    A pixel is usable if none of the photo's pixels in it is masked or transparent.
    """
    factor = _reduction(camera)
    usable = np.ones(picture.rgb.shape[:2], bool) if picture.mask is None else picture.mask
    if picture.alpha is not None:
        usable = usable & (picture.alpha == 255)
    reduced = replace(picture, mask=usable)
    if factor > 1:
        reduced = reduce_picture(reduced, factor)
    assert reduced.mask is not None
    grey = reduced.rgb.mean(-1, dtype=np.float32) / np.float32(255)
    if reduced.alpha is not None:
        grey *= reduced.alpha / np.float32(255)
    return Photo(reduce_camera(camera, factor), grey, reduced.mask, shown)


def _agreed_inverse_depths(maps: Sequence[InverseDepthMap | None], index: int, photo: Photo) -> np.ndarray:
    """Return the inverse depths (H, W) of a depth map, 0 where too few photos agree.

    Depths beyond the last plane before infinity are 0 as well: the background sphere shows them.
    """
    depth_map = maps[index]
    if depth_map is None:
        return np.zeros(photo.grey.shape)
    is_near = depth_map.inverse_depths > depth_map.spacing
    return np.where(is_near & (count_agreeing(maps, index) >= MIN_AGREEING_PHOTOS), depth_map.inverse_depths, 0)


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
    shown = camera.in_picture(x, y, z)
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

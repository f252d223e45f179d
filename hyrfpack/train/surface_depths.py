"""Find the depths of the surfaces that photos show, between and beside the points of a reconstruction."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import Delaunay, QhullError

from hyrfpack.data.cache import PictureCache
from hyrfpack.data.reduced import reduce_camera, reduce_picture
from hyrfpack.parallel import has_numba
from hyrfpack.scene import Camera, Picture, Scene, View, evenly_spaced
from hyrfpack.stereo import InverseDepthMap, StereoPhoto, count_agreeing_sources, estimate_depth_maps

MAX_PHOTOS = 100  # More photos are not read: they show the same surfaces.
# Without tracks, points only say which photos show the same place, and how near surfaces can be.
MAX_GUIDING_POINTS = 10_000
# Depths are estimated from photos whose longer side has at most this many pixels.
MAX_DEPTH_MAP_SIDE_PIXELS = 160
MIN_AGREEING_PHOTOS = 1  # A depth is used if at least so many other photos see the point at the same depth.
# A triangle of points with larger ratios of depths is taken for the gap between two surfaces.
MAX_DEPTH_RATIO = 1.3


@dataclass(frozen=True)
class SurfaceDepths:
    """The depths of the surfaces that a photo shows.

    Attributes:
        view: the view of the photo.
        reduction: factor by which the photo was reduced to height H and width W.
        inverse_depths: (H, W) float64, 1 / z in inverse world units at the centres of the reduced photo's pixels; 0
            where it is not known.
        is_agreed: (H, W) bool, where it comes from a depth map with which other photos agree; elsewhere it is
            interpolated between points.
        tracked: (M, 3) world positions of the points between which it is interpolated.
    """

    view: View
    reduction: int
    inverse_depths: np.ndarray
    is_agreed: np.ndarray
    tracked: np.ndarray


def find_surface_depths(scene: Scene, cache: PictureCache) -> list[SurfaceDepths]:
    """Find the depths of the surfaces that training photos show.

    The depth of a pixel is that of a depth map (`estimate_depth_maps`) if at least MIN_AGREEING_PHOTOS other photos
    agree. Other pixels take it from the triangle of tracked points in which they lie (`interpolate_inverse_depths`).
    The depths of masked and transparent pixels are not known. Without Numba there are no depth maps.

    Args:
        scene: a scene with points. Without tracks, a photo counts as showing all points that lie in its picture.
        cache: cache of decoded photos, of which at most MAX_PHOTOS are read. It keeps the result for another call with
            the same object.

    Returns:
        The depths of each photo that was read and shows points.

    Raises:
        HyrfDataError: a photo cannot be read.
    """
    return cache.derive(_compute_surface_depths, scene)


def _compute_surface_depths(scene: Scene, cache: PictureCache) -> list[SurfaceDepths]:
    """Compute what `find_surface_depths` returns."""
    if not scene.tracks and len(scene.points) > MAX_GUIDING_POINTS:
        chosen = np.random.default_rng(0).choice(len(scene.points), MAX_GUIDING_POINTS, replace=False)
        scene = replace(scene, points=scene.points[chosen], point_colors=scene.point_colors[chosen])
    shown = {view.name: scene.shown_points(view) for view in scene.train}
    views = evenly_spaced([view for view in scene.train if len(shown[view.name])], MAX_PHOTOS)
    with closing(cache.stream(views)) as pictures:
        photos = [_reduced_photo(view.camera, picture, shown[view.name]) for view, picture in pictures]
    maps = estimate_depth_maps(photos, scene.points) if has_numba() else [None] * len(photos)
    result = []
    for index, (view, photo) in enumerate(zip(views, photos, strict=True)):
        tracked = scene.points[scene.tracks[view.name]] if scene.tracks else np.zeros((0, 3))
        agreed = _agreed_inverse_depths(maps, index, photo)
        inverse_depths = np.where(agreed > 0, agreed, _interpolated(photo.camera, tracked))
        inverse_depths[~photo.usable] = 0
        result.append(SurfaceDepths(view, _reduction(view.camera), inverse_depths, agreed > 0, tracked))
    return result


def _reduction(camera: Camera) -> int:
    """Return the factor by which a photo is reduced to estimate its depths."""
    shorter, longer = sorted((camera.width, camera.height))
    return min(-(-longer // MAX_DEPTH_MAP_SIDE_PIXELS), shorter)


def _reduced_photo(camera: Camera, picture: Picture, shown: np.ndarray) -> StereoPhoto:
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
    return StereoPhoto(reduce_camera(camera, factor), grey, reduced.mask, shown)


def _agreed_inverse_depths(maps: Sequence[InverseDepthMap | None], index: int, photo: StereoPhoto) -> np.ndarray:
    """Return the inverse depths (H, W) of a depth map, 0 where too few photos agree.

    Depths beyond the last plane before infinity are 0 as well: the background sphere shows them.
    """
    depth_map = maps[index]
    if depth_map is None:
        return np.zeros(photo.grey.shape)
    is_near = depth_map.inverse_depths > depth_map.spacing
    return np.where(is_near & (count_agreeing_sources(maps, index) >= MIN_AGREEING_PHOTOS), depth_map.inverse_depths, 0)


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

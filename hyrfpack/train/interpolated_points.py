"""Add initial points between those of a reconstruction, on the surfaces that the photos show there.

A reconstruction finds points where photos have texture. Between them, on walls and floors, it has few or none.
"""

from __future__ import annotations

from contextlib import closing

import numpy as np
from scipy.spatial import Delaunay, QhullError

from hyrfpack.data.cache import PictureCache
from hyrfpack.scene import Camera, Picture, Scene, evenly_spaced

MAX_PHOTOS = 100  # More photos are not read: they show the same surfaces.
# A triangle of points with larger ratios of depths is taken for the gap between two surfaces.
MAX_DEPTH_RATIO = 1.3
PIXELS_PER_POINT = 2  # So many pixels are drawn for each point, because some are masked or transparent.


def interpolate_points(
    scene: Scene, cache: PictureCache, count: int, generator: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Draw points on surfaces between the tracked points of each photo.

    A photo's tracked points are connected by a Delaunay triangulation of their pixels. A random pixel in a triangle
    gets the photo's colour and an inverse depth that is interpolated linearly between the corners, which is exact on
    planes. Triangles across a jump of depth, and masked or transparent pixels, are left out.

    Args:
        scene: a scene; without tracks it gives no points.
        cache: cache of decoded photos, of which at most MAX_PHOTOS are read.
        count: number of points.
        generator: source of the random pixels.

    Returns:
        World positions (N, 3) float64 and colours (N, 3) float64 in [0, 1], where N is at most `count`.

    Raises:
        HyrfDataError: a photo cannot be read.
    """
    views = evenly_spaced([view for view in scene.train if len(scene.tracks.get(view.name, ()))], MAX_PHOTOS)
    points, colors = [np.zeros((0, 3))], [np.zeros((0, 3))]
    share = -(-count // max(1, len(views)))
    with closing(cache.stream(views)) as pictures:
        for view, picture in pictures:
            tracked = scene.points[scene.tracks[view.name]]
            pixels, depths = draw_surface_pixels(view.camera, tracked, PIXELS_PER_POINT * share, generator)
            usable, rgb = _colors(picture, pixels)
            points.append(view.camera.unproject(pixels[:, 0], pixels[:, 1], depths)[usable][:share])
            colors.append(rgb[usable][:share])
    positions, rgb = np.concatenate(points), np.concatenate(colors)
    chosen = np.sort(generator.permutation(len(positions))[:count])
    return positions[chosen], rgb[chosen]


def draw_surface_pixels(
    camera: Camera, points: np.ndarray, count: int, generator: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Draw random pixels of a photo, evenly over the triangles between its points that are parts of a surface.

    Args:
        camera: the photo's camera.
        points: (M, 3) world positions of points that the photo shows.
        count: number of pixels.
        generator: source of the random pixels.

    Returns:
        x and y in pixels (N, 2), and the depths (N,) along the camera's axis in world units. N is `count`, or 0 if
        there is no such triangle.
    """
    x, y, z = camera.project(points)
    shown = (z > 0) & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
    places, inverse_depths = np.stack([x, y], 1)[shown], 1 / z[shown]
    nothing = np.zeros((0, 2)), np.zeros(0)
    if len(places) < 3:
        return nothing
    try:
        triangles = Delaunay(places).simplices
    except QhullError:  # all points lie in a line
        return nothing
    corners, inverse = places[triangles], inverse_depths[triangles]
    (ax, ay), (bx, by) = (corners[:, 1] - corners[:, 0]).T, (corners[:, 2] - corners[:, 0]).T
    areas = np.abs(ax * by - ay * bx) * (inverse.max(1) < MAX_DEPTH_RATIO * inverse.min(1))
    if not areas.any():
        return nothing
    chosen = generator.choice(len(areas), count, p=areas / areas.sum())
    weights = generator.dirichlet((1.0, 1.0, 1.0), count)[:, None]  # uniform within a triangle
    return (weights @ corners[chosen])[:, 0], 1 / (weights @ inverse[chosen][..., None])[:, 0, 0]


def _colors(picture: Picture, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return which pixels (N, 2) are neither masked nor transparent, (N,) bool, and their colours (N, 3) in [0, 1]."""
    height, width = picture.rgb.shape[:2]
    column = np.minimum(pixels[:, 0].astype(np.int64), width - 1)
    row = np.minimum(pixels[:, 1].astype(np.int64), height - 1)
    usable = np.ones(len(pixels), bool)
    if picture.alpha is not None:
        usable &= picture.alpha[row, column] == 255
    if picture.mask is not None:
        usable &= picture.mask[row, column]
    return usable, picture.rgb[row, column] / 255

"""Draw initial points on the surfaces that photos show, between and beside the points of a reconstruction.

A reconstruction finds points where photos have texture. On walls, floors and trees it has few or none.
"""

from __future__ import annotations

from contextlib import closing

import numpy as np

from hyrfpack.data.cache import PictureCache
from hyrfpack.scene import Scene
from hyrfpack.train.surface_depths import SurfaceDepths, find_surface_depths, interpolate_inverse_depths

MAX_POINTS_PER_PIXEL = 4  # of a depth map, so that a few false depths do not get all points


def draw_surface_points(
    scene: Scene, cache: PictureCache, count: int, generator: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Draw points at random pixels of photos whose depth is known (`find_surface_depths`), with the pixels' colours.

    Args:
        scene: a scene with points.
        cache: cache of decoded photos. At most MAX_PHOTOS are read: for the depths, unless it keeps these, and for the
            colours.
        count: number of points.
        generator: source of the random pixels.

    Returns:
        World positions (N, 3) float64 and colours (N, 3) float64 in [0, 1]. N is `count`, or MAX_POINTS_PER_PIXEL times
        the number of pixels of known depth if that is less.

    Raises:
        HyrfDataError: a photo cannot be read.
    """
    photos = find_surface_depths(scene, cache)
    pixel_counts = np.array([np.count_nonzero(photo.inverse_depths) for photo in photos], np.float64)
    if not pixel_counts.sum():
        return np.zeros((0, 3)), np.zeros((0, 3))
    count = min(count, MAX_POINTS_PER_PIXEL * int(pixel_counts.sum()))
    shares = generator.multinomial(count, pixel_counts / pixel_counts.sum())
    drawn = []
    with closing(cache.stream(photo.view for photo in photos)) as pictures:
        for photo, share, (view, picture) in zip(photos, shares, pictures, strict=True):
            if share:
                pixels, inverse_depths = _draw_pixels(photo, share, generator)
                x, y = np.minimum(pixels.astype(np.int64), (view.camera.width - 1, view.camera.height - 1)).T
                positions = view.camera.unproject(pixels[:, 0], pixels[:, 1], 1 / inverse_depths)
                drawn.append((positions, picture.rgb[y, x] / 255))
    positions, colors = (np.concatenate(parts) for parts in zip(*drawn, strict=True))
    return positions, colors


def _draw_pixels(photo: SurfaceDepths, count: int, generator: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Draw random pixels of a photo where the depth is known.

    Interpolated depths are interpolated again, at the places that are drawn.

    Returns:
        x and y in pixels (N, 2) and inverse depths (N,).
    """
    rows, columns = np.nonzero(photo.inverse_depths)
    chosen = generator.integers(len(rows), size=count)
    row, column = rows[chosen], columns[chosen]
    pixels = (np.stack([column, row], 1) + generator.uniform(size=(count, 2))) * photo.reduction
    inverse_depths = photo.inverse_depths[row, column]
    if len(photo.tracked):
        interpolated = interpolate_inverse_depths(photo.view.camera, photo.tracked, pixels)
        inverse_depths = np.where(~photo.is_agreed[row, column] & (interpolated > 0), interpolated, inverse_depths)
    return pixels, inverse_depths

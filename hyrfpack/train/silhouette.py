"""Sample random points inside an object's visual hull."""

from __future__ import annotations

import numpy as np

from hyrfpack.model import Frame
from hyrfpack.scene import Scene, evenly_spaced

MAX_SILHOUETTES = 24  # More silhouettes would hardly make the hull smaller.
MIN_COVERED_SHARE = 0.95  # A point is inside if at least this share of the views that see it cover it.


def inside_silhouettes(
    scene: Scene, frame: Frame, count: int, generator: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Draw points in the frame's box that project onto covered pixels in nearly every view that sees them.

    Returns:
        Local positions (N, 3) and mean pixel colours (N, 3) in [0, 1], where N is at most `count`. If fewer than a
        tenth of `count` points are found inside the silhouettes, grey points of the whole box make up the rest.
    """
    pictures = [(view.camera, view.load()) for view in evenly_spaced(scene.train, MAX_SILHOUETTES)]
    half = np.array(frame.half_extent)
    kept_points: list[np.ndarray] = []
    kept_colors: list[np.ndarray] = []
    found = 0
    for _ in range(20):
        points = generator.uniform(-half, half, (4 * count, 3))
        world = frame.to_world(points)
        seen = np.zeros(len(points))
        covered = np.zeros(len(points))
        colors = np.zeros((len(points), 3))
        for camera, picture in pictures:
            x, y, z = camera.project(world)
            column, row = np.floor(x), np.floor(y)
            inside = (z > 0) & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
            column, row = column[inside].astype(np.int64), row[inside].astype(np.int64)
            coverage = np.ones(len(column)) if picture.alpha is None else picture.alpha[row, column] / 255
            seen[inside] += 1
            covered[inside] += coverage > 0.5
            colors[inside] += coverage[:, None] * (picture.rgb[row, column] / 255)
        good = (seen > 0) & (covered >= MIN_COVERED_SHARE * seen)
        kept_points.append(points[good])
        kept_colors.append(colors[good] / covered[good, None].clip(1))
        found += int(good.sum())
        if found >= count:
            break
    points, colors = np.concatenate(kept_points)[:count], np.concatenate(kept_colors)[:count].clip(0, 1)
    if len(points) < max(1, count // 10):
        missing = count - len(points)
        points = np.concatenate([points, generator.uniform(-half, half, (missing, 3))])
        colors = np.concatenate([colors, np.full((missing, 3), 0.5)])
    return points, colors

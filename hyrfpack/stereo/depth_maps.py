"""Estimate the depths of a photo's pixels from other photos, and which photos agree with them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hyrfpack.scene import Camera
from hyrfpack.stereo.aggregate import aggregate_costs
from hyrfpack.stereo.cost import sweep_costs
from hyrfpack.stereo.sources import choose_sources

PLANES = 64
# The nearest plane lies at this share of the depth of the near points of a photo.
NEAREST_SHARE = 0.6
NEAR_QUANTILE = 0.02
MAX_DIFFERENCE_PLANES = 1.5  # Depths agree if they differ by at most this.


@dataclass(frozen=True)
class Photo:
    """A photo as its depths are estimated.

    Attributes:
        camera: its camera.
        grey: (H, W) float32, grey values in [0, 1].
        points: indices of the points that it shows.
    """

    camera: Camera
    grey: np.ndarray
    points: np.ndarray


@dataclass(frozen=True)
class DepthMap:
    """Inverse depths of a photo's pixels.

    Attributes:
        camera: the photo's camera.
        inverse: (H, W) float64, 1 / z in inverse world units; 0 is infinitely far.
        spacing: difference between the inverse depths of neighbouring planes.
        sources: indices of the photos that it was compared with.
    """

    camera: Camera
    inverse: np.ndarray
    spacing: float
    sources: list[int]


def estimate_depth_maps(photos: Sequence[Photo], points: np.ndarray) -> list[DepthMap | None]:
    """Estimate the depth maps of photos.

    PLANES planes have evenly spaced inverse depths, from 0 to 1 / z with z = NEAREST_SHARE times the NEAR_QUANTILE of
    the depths of the photo's points. The photo is compared with others on each plane (`sweep_costs`), costs are
    smoothed (`aggregate_costs`), and a parabola through the lowest cost and its neighbours refines the depth.

    Args:
        photos: N photos.
        points: (P, 3) world positions of the points of `Photo.points`.

    Returns:
        N depth maps; None for a photo that shows no point or shares too few with others.
    """
    sources = choose_sources([photo.camera for photo in photos], points, [photo.points for photo in photos])
    return [
        _estimate(photo, points, [photos[i] for i in near], near) for photo, near in zip(photos, sources, strict=True)
    ]


def _estimate(photo: Photo, points: np.ndarray, others: Sequence[Photo], sources: list[int]) -> DepthMap | None:
    _, _, z = photo.camera.project(points[photo.points])
    z = z[z > 0]
    if not len(z) or not others:
        return None
    nearest = max(NEAREST_SHARE * float(np.quantile(z, NEAR_QUANTILE)), np.finfo(np.float64).tiny)
    inverses = np.linspace(0, 1 / nearest, PLANES)
    costs = sweep_costs(photo.camera, photo.grey, [(other.camera, other.grey) for other in others], inverses)
    total = aggregate_costs(costs, photo.grey)
    best = total.argmin(-1)
    middle = np.clip(best, 1, PLANES - 2)
    before, at, after = (np.take_along_axis(total, (middle + step)[..., None], -1)[..., 0] for step in (-1, 0, 1))
    curvature = np.maximum(before - 2 * at + after, 1e-6)
    shift = np.where(best == middle, np.clip((before - after) / (2 * curvature), -0.5, 0.5), 0)
    spacing = float(inverses[1])
    return DepthMap(photo.camera, (best + shift) * spacing, spacing, sources)


def count_agreeing(maps: Sequence[DepthMap | None], index: int) -> np.ndarray:
    """Count for each pixel of a depth map how many of its sources see its point at the same depth.

    A source agrees if the point lies in its picture, and its inverse depth differs by at most MAX_DIFFERENCE_PLANES of
    the source's planes from that of the source's depth map.

    Args:
        maps: all depth maps.
        index: which of them; not None.

    Returns:
        (H, W) int64.
    """
    depth_map = maps[index]
    assert depth_map is not None
    height, width = depth_map.inverse.shape
    y, x = (np.mgrid[:height, :width] + 0.5).reshape(2, -1)
    z = 1 / np.maximum(depth_map.inverse.ravel(), 0.25 * depth_map.spacing)
    points = depth_map.camera.unproject(x, y, z)
    votes = np.zeros(height * width, np.int64)
    for source in depth_map.sources:
        other = maps[source]
        if other is None:
            continue
        u, v, depth = other.camera.project(points)
        inside = (depth > 0) & (u >= 0) & (u < other.camera.width) & (v >= 0) & (v < other.camera.height)
        inverse = other.inverse[v[inside].astype(np.int64), u[inside].astype(np.int64)]
        agrees = np.abs(inverse - 1 / depth[inside]) <= MAX_DIFFERENCE_PLANES * other.spacing
        votes[np.flatnonzero(inside)[agrees]] += 1
    return votes.reshape(height, width)

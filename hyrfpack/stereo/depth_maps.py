"""Estimate the depths of a photo's pixels from other photos, and count how many photos confirm each depth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hyrfpack.scene import Camera
from hyrfpack.stereo.sources import choose_sources

PLANE_COUNT = 64
# The depth of the nearest plane is this ratio of the depth at this quantile of the photo's points.
NEAREST_PLANE_DEPTH_RATIO = 0.6
NEAR_POINT_QUANTILE = 0.02
MAX_DIFFERENCE_PLANES = 1.5  # depths agree if their inverses differ by at most as many plane spacings
# A point at infinity has no position, so inverse depths are raised to this many plane spacings for the comparison.
MIN_COMPARED_INVERSE_DEPTH_PLANES = 0.25


@dataclass(frozen=True)
class StereoPhoto:
    """A photo, reduced to what the estimation of depths reads.

    Attributes:
        camera: its camera.
        grey: (H, W) float32, grey values in [0, 1].
        usable: (H, W) bool, False where the photo is masked or transparent. Such pixels confirm no depth of others.
        points: indices of the points that it shows.
    """

    camera: Camera
    grey: np.ndarray
    usable: np.ndarray
    points: np.ndarray


@dataclass(frozen=True)
class InverseDepthMap:
    """Inverse depths of a photo's pixels.

    Attributes:
        photo: the photo.
        inverse_depths: (H, W) float64, 1 / z in inverse world units; 0 is infinitely far.
        spacing: difference between the inverse depths of neighbouring planes.
        sources: indices of the photos that it was compared with.
    """

    photo: StereoPhoto
    inverse_depths: np.ndarray
    spacing: float
    sources: list[int]


def estimate_depth_maps(photos: Sequence[StereoPhoto], points: np.ndarray) -> list[InverseDepthMap | None]:
    """Estimate the depth maps of photos by plane sweep and semi-global matching.

    PLANE_COUNT planes have evenly spaced inverse depths, from 0 to 1 / z with z = NEAREST_PLANE_DEPTH_RATIO times the
    NEAR_POINT_QUANTILE of the depths of the photo's points. The photo is compared with its source photos on each plane
    (`compute_cost_volume`), costs are smoothed (`aggregate_costs`), and a parabola through the lowest cost and its
    neighbours refines the depth.

    Args:
        photos: N photos.
        points: (P, 3) world positions of the points of `StereoPhoto.points`.

    Returns:
        N depth maps; None for a photo that shows no point, or for which there are no suitable source photos.

    Raises:
        ImportError: Numba is missing.
    """
    sources = choose_sources([photo.camera for photo in photos], points, [photo.points for photo in photos])
    return [_estimate_depth_map(photo, points, photos, own) for photo, own in zip(photos, sources, strict=True)]


def _estimate_depth_map(
    photo: StereoPhoto, points: np.ndarray, photos: Sequence[StereoPhoto], sources: list[int]
) -> InverseDepthMap | None:
    """Estimate the depth map of one photo from its source photos, whose indices are `sources`."""
    from hyrfpack.stereo.aggregate import aggregate_costs  # imported here, because packing a model does not need Numba
    from hyrfpack.stereo.cost import compute_cost_volume

    _, _, z = photo.camera.project(points[photo.points])
    z = z[z > 0]
    if not len(z) or not sources:
        return None
    nearest = NEAREST_PLANE_DEPTH_RATIO * float(np.quantile(z, NEAR_POINT_QUANTILE))
    planes = np.linspace(0, 1 / max(nearest, np.finfo(np.float64).tiny), PLANE_COUNT)
    others = [(photos[source].camera, photos[source].grey) for source in sources]
    volume = compute_cost_volume(photo.camera, photo.grey, others, planes)
    total = aggregate_costs(volume, photo.grey)
    best = total.argmin(-1)
    middle = np.clip(best, 1, PLANE_COUNT - 2)
    previous, centre, following = (
        np.take_along_axis(total, (middle + step)[..., None], -1)[..., 0] for step in (-1, 0, 1)
    )
    curvature = np.maximum(previous - 2 * centre + following, 1e-6)
    shift = np.where(best == middle, np.clip((previous - following) / (2 * curvature), -0.5, 0.5), 0)
    spacing = float(planes[1])
    return InverseDepthMap(photo, (best + shift) * spacing, spacing, sources)


def count_agreeing_sources(maps: Sequence[InverseDepthMap | None], index: int) -> np.ndarray:
    """Count for each pixel of a depth map the source photos that see its point at the same depth.

    A source photo agrees if the point lies in a usable pixel of it, and its inverse depth differs by at most
    MAX_DIFFERENCE_PLANES of the source photo's planes from that of its depth map (geometric consistency).

    Args:
        maps: all depth maps.
        index: index of the depth map, which is not None.

    Returns:
        (H, W) int64 numbers of source photos.
    """
    depth_map = maps[index]
    assert depth_map is not None
    height, width = depth_map.inverse_depths.shape
    y, x = (np.mgrid[:height, :width] + 0.5).reshape(2, -1)
    z = 1 / np.maximum(depth_map.inverse_depths.ravel(), MIN_COMPARED_INVERSE_DEPTH_PLANES * depth_map.spacing)
    points = depth_map.photo.camera.unproject(x, y, z)
    votes = np.zeros(height * width, np.int64)
    for source in depth_map.sources:
        other = maps[source]
        if other is None:
            continue
        camera = other.photo.camera
        u, v, depth = camera.project(points)
        inside = np.flatnonzero(camera.in_picture(u, v, depth))
        row, column = v[inside].astype(np.int64), u[inside].astype(np.int64)
        difference = np.abs(other.inverse_depths[row, column] - 1 / depth[inside])
        agrees = other.photo.usable[row, column] & (difference <= MAX_DIFFERENCE_PLANES * other.spacing)
        votes[inside[agrees]] += 1
    return votes.reshape(height, width)

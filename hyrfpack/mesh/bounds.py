"""The box that a mesh covers, and the size of its voxels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hyrfpack.errors import HyrfError
from hyrfpack.mesh.depth_maps import DepthMap

MAX_POINTS_PER_MAP = 5000
BOX_QUANTILES = 0.002, 0.998
# If less than this share of what the cameras see lies nearer to the centre than the cameras do, they look outwards.
MIN_INNER_SHARE = 0.25
DEFAULT_VOXEL_PIXELS = 1.5
MAX_VOXELS_PER_DEFAULT_SIDE = 512
# Positions along an axis must fit into the keys by which vertices are welded.
MAX_VOXELS_PER_SIDE = 8000
# No triangle remains of a surface that lies in a single voxel.
MIN_VOXELS_ON_LONGEST_SIDE = 2
PEAK_BYTES_PER_SURFACE_VOXEL = 800  # measured 614: triangles, and their clean-up


@dataclass(frozen=True)
class Grid:
    """A grid of voxels.

    Attributes:
        low: (3,) float64 corner of the grid, world units.
        voxel: side of a voxel, world units.
        shape: number of voxels along each axis.
    """

    low: np.ndarray
    voxel: float
    shape: tuple[int, int, int]


def choose_grid(
    maps: Sequence[DepthMap], center: np.ndarray, crop: Sequence[float] | None, voxel: float | None
) -> Grid:
    """Choose the box and the voxels of a mesh.

    The default box holds what the cameras see nearer to the centre than the median camera is, or nearly all that they
    see if they look outwards. The default voxel is DEFAULT_VOXEL_PIXELS times the median size of a pixel on the
    surfaces in the box, and at least 1/MAX_VOXELS_PER_DEFAULT_SIDE of the box.

    Args:
        maps: depth maps.
        center: (3,) centre of interest, world units.
        crop: box (min x, y, z, max x, y, z) in world units, infinite where a side is open; None for the default box.
        voxel: side of a voxel in world units; None for the default.

    Raises:
        HyrfError: no surface lies in the box, there are more than MAX_VOXELS_PER_SIDE voxels along a side, or
            `voxel` leaves fewer than MIN_VOXELS_ON_LONGEST_SIDE.
    """
    sampled = [_sample_points(depth_map) for depth_map in maps]
    points = np.concatenate([points for points, _ in sampled])
    sizes = np.concatenate([sizes for _, sizes in sampled])
    if not len(points):
        raise HyrfError("no camera sees a surface, so there is no mesh", fix="name the photos with `data`")
    low, high = choose_default_box(points, center, np.array([depth_map.camera.position for depth_map in maps]))
    if crop is not None:
        limits = np.asarray(crop, np.float64)
        low, high = (
            np.where(np.isfinite(side), side, default)
            for side, default in ((limits[:3], points.min(axis=0)), (limits[3:], points.max(axis=0)))
        )
    inside = ((points >= low) & (points <= high)).all(axis=1)
    if not inside.any():
        corners = " and ".join(str(corner.round(3).tolist()) for corner in (points.min(axis=0), points.max(axis=0)))
        raise HyrfError(
            f"no camera sees a surface in the box; the surfaces that they see lie between {corners}",
            fix="move or widen `crop`",
        )
    # A crop may be far larger than what is seen in it.
    low, high = np.maximum(low, points[inside].min(axis=0)), np.minimum(high, points[inside].max(axis=0))
    if voxel is None:
        voxel = max(
            DEFAULT_VOXEL_PIXELS * float(np.median(sizes[inside])),
            float((high - low).max()) / MAX_VOXELS_PER_DEFAULT_SIDE,
        )
    elif voxel * MIN_VOXELS_ON_LONGEST_SIDE > (high - low).max():
        raise HyrfError(
            f"a voxel of {voxel:g} is too large for a surface of {_format_sides(high - low)} units; the longest side "
            f"needs at least {MIN_VOXELS_ON_LONGEST_SIDE}",
            fix="use a smaller `voxel`",
        )
    margin = 0.0 if crop is not None else 2 * voxel
    low, high = low - margin, high + margin
    counts = np.ceil((high - low) / voxel).clip(min=1)
    if counts.max() > MAX_VOXELS_PER_SIDE:
        gigabytes = PEAK_BYTES_PER_SURFACE_VOXEL * float(counts.max()) ** 2 / 1e9
        raise HyrfError(
            f"a voxel of {voxel:g} divides the box of {_format_sides(high - low)} units into "
            f"{counts.max():,.0f} voxels along a side, which would take about "
            f"{gigabytes:,.0f} GB; the limit is {MAX_VOXELS_PER_SIDE:,} voxels",
            fix="use a larger `voxel` or a smaller `crop`",
        )
    x, y, z = counts.astype(int).tolist()
    return Grid(low, voxel, (x, y, z))


def _format_sides(sides: np.ndarray) -> str:
    return " x ".join(f"{side:.3g}" for side in sides)


def choose_default_box(points: np.ndarray, center: np.ndarray, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners (3,) of the box around what cameras at `positions` (N, 3) see near the centre."""
    reach = np.median(np.linalg.norm(positions - center, axis=1))
    is_near = np.linalg.norm(points - center, axis=1) <= reach
    chosen = points[is_near] if is_near.mean() >= MIN_INNER_SHARE else points
    low, high = np.quantile(chosen, BOX_QUANTILES, axis=0)
    return low, high


def _sample_points(depth_map: DepthMap) -> tuple[np.ndarray, np.ndarray]:
    """Return points (n, 3) of a map, world units, and the size (n,) of their pixels there."""
    stride = max(1, round((depth_map.depth.size / MAX_POINTS_PER_MAP) ** 0.5))
    points, camera = depth_map.surface_points(stride), depth_map.camera
    return points, ((points - camera.position) @ camera.forward) / camera.fx

"""Extraction of a mesh from a model: render depth maps, fuse them, clean the surface and colour it."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from threading import Lock

import numpy as np
from scipy.spatial import cKDTree

from hyrfpack.choices import AS_PHOTOGRAPHED
from hyrfpack.counts import format_count
from hyrfpack.errors import HyrfError
from hyrfpack.mesh.bounds import choose_grid
from hyrfpack.mesh.clean import reduce_faces, remove_small_components
from hyrfpack.mesh.depth_maps import render_depth_maps
from hyrfpack.mesh.fusion import MIN_TOTAL_WEIGHT, choose_truncation, extract_surface, find_blocks
from hyrfpack.mesh.kernels import MapArrays, color_points
from hyrfpack.model import HybridModel
from hyrfpack.model.merged import MergedModel
from hyrfpack.parallel.pool import run_ranges
from hyrfpack.progress import Progress, TaskEvent, ignore_progress
from hyrfpack.scene import Camera, evenly_spaced

_LOG = logging.getLogger(__name__)

MAX_MAPS = 160
# Scenes of fewer cameras than this need less than MIN_TOTAL_WEIGHT, in proportion.
FEW_MAPS = 12
COLOR_TOLERANCE_TRUNCATIONS = 1.0


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh.

    Attributes:
        vertices: (V, 3) float64 positions, world units.
        faces: (F, 3) int64 vertices of each triangle, counter-clockwise seen from outside.
        colors: (V, 3) uint8 sRGB; None for the shape alone.
        voxel: side of the voxels of the fusion, world units.
        truncation: truncation of the signed distance, world units.
        maps: number of depth maps that were fused.
    """

    vertices: np.ndarray
    faces: np.ndarray
    colors: np.ndarray | None
    voxel: float
    truncation: float
    maps: int


def extract_mesh(
    model: HybridModel | MergedModel,
    cameras: Sequence[Camera],
    center: np.ndarray,
    *,
    crop: Sequence[float] | None = None,
    voxel: float | None = None,
    faces: int | None = None,
    exposure: str = AS_PHOTOGRAPHED,
    colored: bool = True,
    progress: Progress = ignore_progress,
) -> Mesh:
    """Extract the surface of a model by truncated signed distance fusion of rendered median depths.

    Only Gaussians become surface, never the background sphere.

    Args:
        model: a model on the CPU.
        cameras: cameras from which the surface is seen; MAX_MAPS evenly spaced ones of them are used.
        center: (3,) centre of interest, world units.
        crop: box (min x, y, z, max x, y, z) of the mesh in world units; None for what the cameras see near the centre.
        voxel: side of a voxel in world units; None for the default of `choose_grid`.
        faces: largest number of triangles; None for all.
        exposure: exposure of the colours, as in `RenderSettings`.
        colored: whether vertices get colours.
        progress: called with `TaskEvent`s.

    Raises:
        HyrfError: no camera sees a surface in the box, the voxels are too small for the memory, or a package is
            missing.
    """
    chosen = evenly_spaced(cameras, MAX_MAPS)
    maps = []
    for depth_map in render_depth_maps(model, chosen, exposure):
        maps.append(depth_map)
        progress(TaskEvent("rendering depth", 0.5 * len(maps) / len(chosen), len(maps), len(chosen)))
    grid = choose_grid(maps, center, crop, voxel)
    truncation = choose_truncation(maps, grid)
    blocks = find_blocks(maps, grid)
    _LOG.info(
        f"fusing {format_count(len(maps), 'depth map')} in {format_count(len(blocks), 'block')} with "
        f"voxels of {grid.voxel:.4g} and a truncation of "
        f"{truncation:.4g} units"
    )
    fused_count, lock = 0, Lock()

    def count_block() -> None:
        nonlocal fused_count
        with lock:
            fused_count += 1
            progress(TaskEvent("fusing depth", 0.5 + 0.35 * fused_count / len(blocks), fused_count, len(blocks)))

    arrays = MapArrays.pack(maps)
    del maps
    min_weight = MIN_TOTAL_WEIGHT * min(1.0, len(chosen) / FEW_MAPS)
    vertices, triangles = extract_surface(arrays, grid, blocks, truncation, min_weight, count_block)
    if not len(triangles):
        problem = "the depth maps agree on no surface"
        raise HyrfError(problem, fix="use a larger `voxel`, or name the photos with `data`")
    progress(TaskEvent("cleaning the surface", 0.85))
    vertices, triangles = remove_small_components(vertices, triangles)
    if faces is not None:
        progress(TaskEvent("reducing triangles", 0.9))
        vertices, triangles = reduce_faces(vertices, triangles, faces)
    colors = None
    if colored:
        progress(TaskEvent("colouring the surface", 0.95))
        colors = _color_vertices(arrays, vertices, COLOR_TOLERANCE_TRUNCATIONS * truncation)
    return Mesh(vertices, triangles, colors, grid.voxel, truncation, len(chosen))


def _color_vertices(arrays: MapArrays, vertices: np.ndarray, tolerance: float) -> np.ndarray:
    """Return the mean colours (V, 3) uint8 of vertices (V, 3) in the maps that see them."""
    sums = np.empty((len(vertices), 4), np.float32)
    run_ranges(lambda first, last: color_points(first, last, vertices, tolerance, *arrays, sums), len(vertices))
    is_seen = sums[:, 3] > 0
    if is_seen.any() and not is_seen.all():  # others take the colour of the nearest vertex that has one
        _, nearest = cKDTree(vertices[is_seen]).query(vertices[~is_seen])
        sums[~is_seen] = sums[is_seen][nearest]
    return np.round(sums[:, :3] / np.maximum(sums[:, 3:], 1e-30)).astype(np.uint8)

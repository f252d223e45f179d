"""Fusion of depth maps into a truncated signed distance, block by block, and its zero surface.

Only blocks of voxels that hold a surface of some map are fused. Each is fused over all maps at once, and its triangles
are extracted before the next, so that memory holds the maps, a block for each thread, and the triangles.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from hyrfpack.data.cache import memory_bytes
from hyrfpack.errors import HyrfError, needs_package
from hyrfpack.mesh.bounds import PEAK_BYTES_PER_SURFACE_VOXEL, Grid
from hyrfpack.mesh.depth_maps import DepthMap
from hyrfpack.mesh.kernels import MapArrays, fuse_block
from hyrfpack.parallel.pool import parallel_map

BLOCK_VOXELS = 32
MIN_TRUNCATION_VOXELS, MAX_TRUNCATION_VOXELS = 5.0, 8.0
TRUNCATION_PER_NOISE = 3.0
NOISE_VIEWS = 24
# A voxel counts if the maps that see it have this sum of weights, where one map that sees a surface face on has 255.
MIN_TOTAL_WEIGHT = 255.0
# Surfaces may lie this far from the depth of the single map that made a block known.
BLOCK_MARGIN_VOXELS = 1.5
WELD_STEPS_PER_VOXEL = 256
MAX_MEMORY_SHARE = 0.5

Triangles = tuple[np.ndarray, np.ndarray]


def choose_truncation(maps: Sequence[DepthMap], grid: Grid) -> float:
    """Choose the truncation, in world units, by the voxel and by how far the maps' depths differ from each other."""
    limit = MAX_TRUNCATION_VOXELS * grid.voxel
    noise = estimate_depth_noise(maps, grid, limit)
    return float(np.clip(TRUNCATION_PER_NOISE * noise, MIN_TRUNCATION_VOXELS * grid.voxel, limit))


def estimate_depth_noise(maps: Sequence[DepthMap], grid: Grid, limit: float) -> float:
    """Estimate the standard deviation of depths, world units, from points of maps that other maps see, too.

    Differences beyond `limit` are left out, because they come from surfaces in front.
    """
    high = grid.low + grid.voxel * np.array(grid.shape)
    differences = [np.zeros(0)]
    sampled_maps = [maps[index] for index in np.linspace(0, len(maps) - 1, min(len(maps), NOISE_VIEWS)).astype(int)]
    for source in sampled_maps:
        points = source.surface_points(max(1, round((source.depth.size / 500) ** 0.5)))
        points = points[((points >= grid.low) & (points <= high)).all(axis=1)]
        for target in sampled_maps:
            if target is not source:
                u, v, z = target.camera.project(points)
                is_in_picture = (z > 0) & (u >= 0) & (v >= 0) & (u < target.camera.width) & (v < target.camera.height)
                rows, columns = v[is_in_picture].astype(int), u[is_in_picture].astype(int)
                distances = np.abs(target.depth[rows, columns] - z[is_in_picture])
                weight = target.weight[rows, columns] / 255
                is_same_surface = (weight > 0) & (distances < limit)
                # The weight is about the cosine, so the product is about the distance to the surface's plane.
                differences.append(distances[is_same_surface] * weight[is_same_surface])
    all_differences = np.concatenate(differences)
    # The difference of two depths has sqrt(2) times the deviation of each.
    return 1.4826 / 2**0.5 * float(np.median(all_differences)) if len(all_differences) else 0.0


def find_blocks(maps: Sequence[DepthMap], grid: Grid) -> np.ndarray:
    """Return the blocks (B, 3) int64 of the grid, in units of BLOCK_VOXELS, that hold a surface of some map.

    Raises:
        HyrfError: the mesh would not fit into memory.
    """
    shape = -(-np.array(grid.shape, np.int64) // BLOCK_VOXELS)
    numbers = np.zeros(0, np.int64)
    for depth_map in maps:
        blocks = find_blocks_near((depth_map.surface_points() - grid.low) / (grid.voxel * BLOCK_VOXELS), shape)
        numbers = np.union1d(numbers, np.ravel_multi_index(tuple(blocks.T), shape))
        needed_bytes, machine_bytes = len(numbers) * BLOCK_VOXELS**2 * PEAK_BYTES_PER_SURFACE_VOXEL, memory_bytes()
        if needed_bytes > MAX_MEMORY_SHARE * machine_bytes:
            raise HyrfError(
                f"a mesh with voxels of {grid.voxel:g} units would take more than {needed_bytes / 1e9:.1f} GB, and "
                f"this machine has {machine_bytes / 1e9:.1f} GB",
                fix="use a larger `voxel` or a smaller `crop`",
            )
    return np.stack(np.unravel_index(numbers, shape), axis=1)


def find_blocks_near(points: np.ndarray, shape: np.ndarray) -> np.ndarray:
    """Return the blocks (B, 3) int64 that lie within BLOCK_MARGIN_VOXELS of points, those inside the grid.

    Args:
        points: (N, 3) points in units of a block, from the corner of the grid.
        shape: (3,) number of blocks along each axis.
    """
    margin = BLOCK_MARGIN_VOXELS / BLOCK_VOXELS
    first, last = (np.floor(points + sign * margin).astype(np.int64) for sign in (-1, 1))
    is_near = ((last >= 0) & (first < shape)).all(axis=1)
    # Many points lie in few blocks, so points are reduced to their first block and the axes along which they touch two.
    widest = shape + 1
    rows = np.ravel_multi_index(tuple(first[is_near].T + 1), widest) * 8 + (last - first)[is_near] @ (1, 2, 4)
    rows = np.unique(rows)
    corners = np.stack(np.unravel_index(rows // 8, widest), axis=1) - 1
    corners_by_axes = [corners[rows & axes == axes] + (axes & 1, axes >> 1 & 1, axes >> 2) for axes in range(8)]
    blocks = np.unique(np.concatenate(corners_by_axes), axis=0)
    return blocks[((blocks >= 0) & (blocks < shape)).all(axis=1)]


def extract_surface(
    maps: MapArrays,
    grid: Grid,
    blocks: np.ndarray,
    truncation: float,
    min_weight: float = MIN_TOTAL_WEIGHT,
    on_block: Callable[[], None] = lambda: None,
) -> Triangles:
    """Fuse all blocks and return the vertices (V, 3) float64, world units, and the triangles (F, 3) int64.

    Triangles are counter-clockwise seen from the cameras. The surface ends where no camera sees it.

    Args:
        maps: the depth maps.
        grid: the grid.
        blocks: (B, 3) result of `find_blocks`.
        truncation: largest distance from a surface that counts, world units.
        min_weight: smallest sum of weights of a voxel.
        on_block: called after each block.

    Raises:
        HyrfError: scikit-image is missing.
    """

    def extract(block: np.ndarray) -> Triangles:
        result = _extract_block(maps, grid, block * BLOCK_VOXELS, truncation, min_weight)
        on_block()
        return result

    parts = [part for part in parallel_map(extract, list(blocks)) if len(part[1])]
    if not parts:
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    vertices = np.concatenate([vertices for vertices, _ in parts])
    faces = np.concatenate([faces + start for (_, faces), start in zip(parts, starts[:-1], strict=True)])
    vertices, faces = _weld(vertices, faces)
    return grid.low + grid.voxel * vertices, faces


def _extract_block(maps: MapArrays, grid: Grid, start: np.ndarray, truncation: float, min_weight: float) -> Triangles:
    """Return the vertices, in voxels from the grid's corner, and the triangles of the block that starts at a voxel."""
    with needs_package("writing a mesh"):
        from skimage.measure import marching_cubes

    nothing = np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    size = BLOCK_VOXELS + 1
    low = grid.low + grid.voxel * start
    views = _find_views_of_block(maps, low, grid.voxel * BLOCK_VOXELS)
    distance, total = np.empty((2, size, size, size), np.float32)
    fuse_block(low, grid.voxel, truncation, views, *maps[:5], distance, total)
    is_known = total >= min_weight
    is_cell_known = np.ones((BLOCK_VOXELS,) * 3, bool)  # cells with all eight corners known
    for corner in np.ndindex(2, 2, 2):
        is_cell_known &= is_known[tuple(slice(at, at + BLOCK_VOXELS) for at in corner)]
    inside = np.minimum(np.array(grid.shape) - start, BLOCK_VOXELS)
    is_cell_known[inside[0] :], is_cell_known[:, inside[1] :], is_cell_known[:, :, inside[2] :] = False, False, False
    if not is_cell_known.any() or not (distance[is_known] < 0).any() or not (distance[is_known] > 0).any():
        return nothing
    mask = np.zeros(distance.shape, bool)
    mask[1:, 1:, 1:] = is_cell_known  # scikit-image looks up a cell at its last corner
    try:
        vertices, faces, _, _ = marching_cubes(distance, 0.0, mask=mask)
    except RuntimeError:  # no cell of the mask holds a surface
        return nothing
    return vertices.astype(np.float64) + start, faces.astype(np.int64)


def _find_views_of_block(maps: MapArrays, low: np.ndarray, side: float) -> np.ndarray:
    """Return the indices of the maps whose pictures may show the block with this corner and side."""
    center, radius = low + side / 2, side * 3**0.5 / 2
    x, y, z = (maps.poses[:, :, :3] @ center + maps.poses[:, :, 3]).T
    fx, fy, cx, cy = maps.lenses.T
    width, height, _ = maps.sizes.T
    keep = z > -radius
    for coordinate, focal, before_center, after_center in ((x, fx, cx, width - cx), (y, fy, cy, height - cy)):
        # The planes through the camera and the picture's sides.
        keep &= (focal * coordinate + before_center * z) / np.hypot(focal, before_center) > -radius
        keep &= (after_center * z - focal * coordinate) / np.hypot(focal, after_center) > -radius
    return np.flatnonzero(keep)


def _weld(vertices: np.ndarray, faces: np.ndarray) -> Triangles:
    """Merge vertices that lie at one place, as at the seams of blocks, and drop triangles without area."""
    steps = np.round(vertices * WELD_STEPS_PER_VOXEL).astype(np.int64)
    keys = (steps[:, 0] << 42) | (steps[:, 1] << 21) | steps[:, 2]
    _, first_index, new_index = np.unique(keys, return_index=True, return_inverse=True)
    faces = new_index[faces]
    has_area = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    return vertices[first_index], faces[has_area]

"""Closed proxies of surfaces for physics engines: a solid behind the surface, its boundary, and few triangles.

A fused surface is open where no camera looks. The solid is a wall of WALL_VOXELS voxels behind it, so that its front is
the surface itself, and its back and its rims close it. Narrow gaps and cavities are filled.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import distance_transform_edt, label
from scipy.spatial import cKDTree

from hyrfpack.errors import HyrfError, needs_package
from hyrfpack.mesh.clean import reduce_faces, remove_small_components
from hyrfpack.mesh.manifold import make_manifold
from hyrfpack.parallel.threads import thread_count

MAX_VOXELS_PER_SIDE = 160
MIN_FUSION_VOXELS = 2.0  # side of a voxel of the solid, in voxels of the fusion
WALL_VOXELS = 3.0
RIM_VOXELS = 1.0  # how far a wall reaches beyond the rim of its surface
GAP_VOXELS = 1.5  # gaps that are narrower than twice this are filled
MIN_COMPONENT_AREA_SHARE = 0.01
CUT_GAP_VOXELS = 0.01
DISTANCE_SAMPLES, DISTANCE_CANDIDATES, DISTANCE_POINTS = 200_000, 8, 20_000
_PLACES_SEED, _POINTS_SEED = 0, 1


@dataclass(frozen=True)
class Proxy:
    """A closed mesh.

    Attributes:
        vertices: (V, 3) float64 positions.
        faces: (F, 3) int64, counter-clockwise seen from outside. Each edge has exactly two.
        wall: thickness of the walls behind the surface, world units.
        surface_distances: (n,) distances from points of the surface to the proxy, evenly over its area.
        proxy_distances: (n,) distances from points of the proxy to the surface. Half of them lie on the back of walls.
    """

    vertices: np.ndarray
    faces: np.ndarray
    wall: float
    surface_distances: np.ndarray
    proxy_distances: np.ndarray


def make_proxy(vertices: np.ndarray, faces: np.ndarray, fusion_voxel: float, max_faces: int) -> Proxy:
    """Make a closed mesh of a surface.

    Args:
        vertices, faces: (V, 3) positions and (F, 3) indices of the surface, whose triangles are counter-clockwise seen
            from outside and not much larger than a voxel.
        fusion_voxel: side of the voxels from which the surface was extracted.
        max_faces: number of triangles to reduce to. A few more may be needed to close the mesh.

    Raises:
        HyrfError: the triangles are too few, or a package is missing.
    """
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    voxel = max(MIN_FUSION_VOXELS * fusion_voxel, float((high - low).max()) / MAX_VOXELS_PER_SIDE)
    closed, triangles = _extract_boundary(*_fill_solid(vertices, faces, voxel), voxel)
    closed, triangles = remove_small_components(closed, triangles, MIN_COMPONENT_AREA_SHARE)
    closed, triangles = make_manifold(*reduce_faces(closed, triangles, max_faces), CUT_GAP_VOXELS * voxel)
    if not len(triangles):
        raise HyrfError(f"{max_faces:,} triangles are too few for this surface", fix="raise `faces`")
    return Proxy(
        closed,
        triangles,
        WALL_VOXELS * voxel,
        measure_distances(vertices, faces, closed, triangles),
        measure_distances(closed, triangles, vertices, faces),
    )


def _fill_solid(vertices: np.ndarray, faces: np.ndarray, voxel: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a field (X, Y, Z), negative in the solid, and the (3,) position of its first node.

    Near the surface, it is the distance to the solid's border. All nodes at the border of the field are positive.
    """
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    margin = int(WALL_VOXELS + GAP_VOXELS) + 3
    shape = np.ceil((high - low) / voxel).astype(int) + 2 * margin + 1
    origin = low - margin * voxel
    is_free = np.ones(shape, bool)
    is_free[tuple(np.round((vertices - origin) / voxel).astype(int).T)] = False
    nodes = np.argwhere(distance_transform_edt(is_free) <= WALL_VOXELS + 2)
    node_positions = origin + voxel * nodes
    distances, nearest = cKDTree(vertices).query(node_positions, workers=thread_count())
    height = ((node_positions - vertices[nearest]) * _compute_vertex_normals(vertices, faces)[nearest]).sum(axis=1)
    sideways = np.sqrt(np.maximum(distances**2 - height**2, 0))
    signed_distances = np.maximum.reduce([height, -height - WALL_VOXELS * voxel, sideways - RIM_VOXELS * voxel])
    field = np.full(shape, WALL_VOXELS * voxel)
    field[tuple(nodes.T)] = signed_distances
    solid = field < 0
    widened = distance_transform_edt(~solid) <= GAP_VOXELS
    filled = distance_transform_edt(widened) > GAP_VOXELS
    regions = label(~filled)[0]
    filled |= (regions != regions[0, 0, 0]) & ~filled
    added = filled & ~solid
    field[added] = np.minimum(field[added], -0.5 * voxel)
    smallest = 1e-6 * voxel  # a zero would make triangles without area
    field[np.abs(field) < smallest] = smallest
    return field, origin


def _extract_boundary(field: np.ndarray, origin: np.ndarray, voxel: float) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and triangles of the zero surface of a field."""
    with needs_package("writing a mesh"):
        from skimage.measure import marching_cubes

    vertices, faces, _, _ = marching_cubes(field, 0.0)
    return origin + voxel * vertices.astype(np.float64), faces.astype(np.int64)


def _compute_vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the unit normals (V, 3) of vertices: the mean of their triangles', weighted by area."""
    corners = vertices[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    sums = np.stack([np.bincount(faces.ravel(), np.repeat(a, 3), len(vertices)) for a in across.T], axis=1)
    return sums / np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-300)


def measure_distances(
    vertices: np.ndarray, faces: np.ndarray, other_vertices: np.ndarray, other_faces: np.ndarray
) -> np.ndarray:
    """Measure the distances (n,) from DISTANCE_POINTS points of a mesh, evenly over its area, to another mesh.

    Each distance is that to the nearest of the triangles of DISTANCE_CANDIDATES samples of the other mesh.
    """
    with needs_package("measuring the error of a mesh"):
        import trimesh

    points, _ = _sample(vertices, faces, DISTANCE_POINTS, _POINTS_SEED)
    samples, triangles = _sample(other_vertices, other_faces, DISTANCE_SAMPLES, _PLACES_SEED)
    _, candidates = cKDTree(samples).query(points, DISTANCE_CANDIDATES, workers=thread_count())
    best = np.full(len(points), np.inf)
    for column in candidates.T:
        corners = other_vertices[other_faces[triangles[column]]]
        nearest = trimesh.triangles.closest_point(corners, points)
        best = np.fmin(best, np.linalg.norm(nearest - points, axis=1))  # NaN for triangles without area
    return best


def _sample(vertices: np.ndarray, faces: np.ndarray, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return points (n, 3), evenly over the area of a mesh, and their triangles (n,)."""
    generator = np.random.default_rng(seed)
    corners = vertices[faces]
    sides = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    areas = np.linalg.norm(np.cross(*sides), axis=1)
    triangles = generator.choice(len(faces), count, p=areas / areas.sum())
    u, v = generator.random((2, count, 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    return corners[triangles, 0] + u * sides[0][triangles] + v * sides[1][triangles], triangles

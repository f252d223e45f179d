"""Clean-up of triangle meshes: components that are too small, and reduction to a number of triangles."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from hyrfpack.errors import needs_package

# Smaller components, as a share of the area of all, are remains of floating Gaussians.
MIN_COMPONENT_AREA_SHARE = 0.002


def remove_small_components(
    vertices: np.ndarray, faces: np.ndarray, min_area_share: float = MIN_COMPONENT_AREA_SHARE
) -> tuple[np.ndarray, np.ndarray]:
    """Remove connected components whose area is below a share of the whole, but never the largest.

    Args:
        vertices, faces: (V, 3) positions and (F, 3) indices.
        min_area_share: smallest share of the area of all triangles.
    """
    if not len(faces):
        return vertices, faces
    edges = np.concatenate((faces[:, :2], faces[:, 1:]))
    graph = coo_matrix((np.ones(len(edges), bool), edges.T), shape=(len(vertices),) * 2)
    component = connected_components(graph, directed=False)[1][faces[:, 0]]
    corners = vertices[faces]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    totals = np.bincount(component, areas)
    keep = (totals >= min_area_share * totals.sum()) | (totals == totals.max())
    return drop_unused_vertices(vertices, faces[keep[component]])


def drop_unused_vertices(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Remove vertices that no triangle has."""
    used, new_index = np.unique(faces, return_inverse=True)
    return vertices[used], new_index.reshape(-1, 3)


def reduce_faces(vertices: np.ndarray, faces: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Reduce a mesh to about `count` triangles by collapsing the edges of least quadric error (Garland, Heckbert 1997).

    Raises:
        HyrfError: fast-simplification or trimesh is missing.
    """
    if len(faces) <= count:
        return vertices, faces
    with needs_package("reducing the triangles of a mesh"):
        import fast_simplification  # noqa: F401 - trimesh imports it
        import trimesh

    middle = vertices.mean(axis=0)  # because the collapse computes in float32
    mesh = trimesh.Trimesh(vertices - middle, faces, process=False).simplify_quadric_decimation(face_count=count)
    return drop_unused_vertices(mesh.vertices + middle, np.asarray(mesh.faces, np.int64))

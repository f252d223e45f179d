"""Makes each edge of a closed mesh the border of exactly two triangles.

Collapsing edges lets sheets of a closed mesh touch: then an edge has four triangles, or a vertex joins two parts. The
sheets are cut apart there. No triangle is lost, so the mesh stays closed.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from hyrfpack.mesh.clean import drop_unused_vertices


def make_manifold(vertices: np.ndarray, faces: np.ndarray, gap: float) -> tuple[np.ndarray, np.ndarray]:
    """Cut the sheets of a closed mesh apart where they touch.

    Args:
        vertices, faces: (V, 3) positions and (F, 3) indices. Each edge has as many triangles in one direction as in the
            other.
        gap: how far vertices are moved where sheets are cut apart, so that programs which merge vertices at one place
            do not join them again.

    Returns:
        Vertices and triangles. Each edge has two triangles, in opposite directions.
    """
    vertices, faces = np.asarray(vertices), _cancel_opposite_faces(faces)
    starts, ends = faces.ravel(), np.roll(faces, -1, axis=1).ravel()  # half-edge h leads from corner h to the next
    partners = _pair_half_edges(vertices, faces, starts, ends)
    new_vertices, corners = _split_vertices(vertices, faces, partners, gap)
    return drop_unused_vertices(*_split_shared_edges(new_vertices, corners, partners, gap))


def _cancel_opposite_faces(faces: np.ndarray) -> np.ndarray:
    """Remove pairs of triangles with the same corners that face opposite directions."""
    ordered = np.sort(faces, axis=1)
    has_area = (ordered[:, 0] != ordered[:, 1]) & (ordered[:, 1] != ordered[:, 2])
    faces, ordered = faces[has_area], ordered[has_area]
    # A cyclic permutation keeps the direction.
    rotated = np.take_along_axis(faces, (faces.argmin(axis=1)[:, None] + np.arange(3)) % 3, axis=1)
    sign = np.where(rotated[:, 1] < rotated[:, 2], 1, -1)
    _, group = np.unique(ordered, axis=0, return_inverse=True)
    group = group.ravel()
    excess = np.bincount(group, sign)[group]
    keep = np.ones(len(faces), bool)
    for index in np.flatnonzero(np.bincount(group)[group] > 1):
        duplicates = np.flatnonzero((group == group[index]) & (sign == np.sign(excess[index])))
        keep[index] = index in duplicates[: int(abs(excess[index]))]
    return faces[keep]


def _pair_half_edges(vertices: np.ndarray, faces: np.ndarray, starts: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Return for each half-edge (3 F,) the one in the opposite direction that bounds the same part of the solid."""
    keys = np.stack((np.minimum(starts, ends), np.maximum(starts, ends)), axis=1)
    _, edge, counts = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
    order, edge = np.argsort(edge.ravel(), kind="stable"), edge.ravel()
    partners = np.empty(len(starts), np.int64)
    plain = order[counts[edge[order]] == 2].reshape(-1, 2)
    partners[plain[:, 0]], partners[plain[:, 1]] = plain[:, 1], plain[:, 0]
    crowded = order[counts[edge[order]] > 2]
    for halves in np.split(crowded, np.flatnonzero(np.diff(edge[crowded])) + 1) if len(crowded) else []:
        for first, second in _pair_around_edge(vertices, faces, starts, ends, halves):
            partners[first], partners[second] = second, first
    return partners


def _pair_around_edge(
    vertices: np.ndarray, faces: np.ndarray, starts: np.ndarray, ends: np.ndarray, halves: np.ndarray
) -> list[tuple[int, int]]:
    """Pair the half-edges of one edge such that between the triangles of a pair there is solid, without another pair.

    Seen along the edge, the solid of a triangle whose half-edge leads along it is at smaller angles.
    """
    low = starts[halves].min()
    forward = starts[halves] == low
    first, last = vertices[low], vertices[np.maximum(starts, ends)[halves[0]]]
    axis = (last - first) / max(np.linalg.norm(last - first), 1e-300)
    across = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    third = vertices[faces.ravel()[halves - halves % 3 + (halves + 2) % 3]] - first
    angles = np.arctan2(third @ np.cross(axis, across), third @ across)
    unpaired = [(int(halves[i]), bool(forward[i])) for i in np.argsort(-angles, kind="stable")]
    pairs = []
    while unpaired:
        position = next(i for i in range(len(unpaired)) if unpaired[i - 1][1] and not unpaired[i][1])
        pairs.append((unpaired[position - 1][0], unpaired[position][0]))
        unpaired = [half for i, half in enumerate(unpaired) if i not in (position, (position - 1) % len(unpaired))]
    return pairs


def _split_vertices(
    vertices: np.ndarray, faces: np.ndarray, partners: np.ndarray, gap: float
) -> tuple[np.ndarray, np.ndarray]:
    """Give each fan of triangles around a vertex a vertex of its own. Returns vertices and triangles."""
    count = 3 * len(faces)
    half = np.arange(count)
    following = half - half % 3 + (half + 1) % 3
    # The corner at the start of a half-edge is the one at the end of its partner.
    graph = coo_matrix((np.ones(count, bool), (half, following[partners])), shape=(count, count))
    fans, fan = connected_components(graph, directed=False)
    source = np.empty(fans, np.int64)
    source[fan] = faces.ravel()
    positions = vertices[source]
    is_split = np.bincount(source, minlength=len(vertices))[source] > 1
    centers = vertices[faces].mean(axis=1)[half // 3]
    sums = np.stack([np.bincount(fan, axis, fans) for axis in centers.T], axis=1)
    toward = sums / np.bincount(fan)[:, None] - positions
    positions[is_split] += _limit_lengths(toward[is_split], gap)
    return positions, fan.reshape(-1, 3)


def _split_shared_edges(
    vertices: np.ndarray, faces: np.ndarray, partners: np.ndarray, gap: float
) -> tuple[np.ndarray, np.ndarray]:
    """Give each pair of half-edges on an edge that still has several pairs a vertex of its own in the middle."""
    starts, ends = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    keys = np.stack((np.minimum(starts, ends), np.maximum(starts, ends)), axis=1)
    _, edge, counts = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
    shared = np.flatnonzero(counts[edge.ravel()] > 2)
    middles: dict[int, int] = {}
    added: list[np.ndarray] = []
    for half in shared.tolist():
        if half > partners[half]:
            continue
        thirds = [vertices[faces.ravel()[h - h % 3 + (h + 2) % 3]] for h in (half, int(partners[half]))]
        middle = (vertices[starts[half]] + vertices[ends[half]]) / 2
        middles[half] = middles[int(partners[half])] = len(vertices) + len(added)
        added.append(middle + _limit_lengths((sum(thirds) / 2 - middle)[None], gap)[0])
    if not added:
        return vertices, faces
    parts = [np.delete(faces, np.unique(shared // 3), axis=0)]
    for face in np.unique(shared // 3).tolist():
        ring: list[int] = []
        for half in range(3 * face, 3 * face + 3):
            ring += [int(starts[half])] + ([middles[half]] if half in middles else [])
        # The polygon is divided from a middle, so that no triangle lies along a side.
        first = next(i for i, corner in enumerate(ring) if corner >= len(vertices))
        ring = ring[first:] + ring[:first]
        parts.append(np.array([(ring[0], ring[i], ring[i + 1]) for i in range(1, len(ring) - 1)]))
    return np.concatenate((vertices, added)), np.concatenate(parts)


def _limit_lengths(vectors: np.ndarray, length: float) -> np.ndarray:
    """Return vectors (N, 3) of the same directions that are at most `length` long."""
    return vectors * np.minimum(1, length / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-300))

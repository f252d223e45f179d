"""Placement of splats in files with a scene graph (glTF, USD): upright, and near an origin of their own.

Such a file stores the splats in the input's axes. A transform in the scene graph turns the scene upright and holds its
distance from the origin, which float32 positions cannot hold precisely.
"""

from __future__ import annotations

import numpy as np

from hyrfpack.errors import HyrfDataError
from hyrfpack.splats.splats import Splats

# A scene farther from the origin than this gets an origin of its own. Up to this distance, float32 resolves at least
# 1/2,000,000 of the scene's size.
_MAX_DISTANCE_IN_SCENE_SIZES = 8


def upright_rotation(up: np.ndarray, target_up: np.ndarray) -> np.ndarray:
    """Return a rotation (3, 3) that maps `up` to `target_up`.

    If the two point in opposite directions, a half turn about x comes first, as between the axes of OpenCV and OpenGL.
    Without it, small changes of `up` would change the axis of the shortest rotation completely.

    Args:
        up: (3,) unit vector that points up in the scene.
        target_up: (3,) unit vector that points up in the file, +y or +z.
    """
    up, target_up = (np.asarray(vector, np.float64) for vector in (up, target_up))
    if up @ target_up < 0:
        half_turn = np.diag([1.0, -1.0, -1.0])
        return _compute_shortest_rotation(half_turn @ up, target_up) @ half_turn
    return _compute_shortest_rotation(up, target_up)


def choose_local_origin(positions: np.ndarray) -> np.ndarray:
    """Choose the origin (3,) float64 relative to which float32 positions are stored.

    It is the world's origin unless the scene is far from there compared to its size. Otherwise it is a point with round
    coordinates near the scene's middle.

    Args:
        positions: (N, 3), world units.
    """
    if not len(positions):
        return np.zeros(3)
    middle = np.median(positions, axis=0)
    size = np.median(np.abs(positions - middle), axis=0).max()
    if np.abs(middle).max() <= _MAX_DISTANCE_IN_SCENE_SIZES * size:
        return np.zeros(3)
    step = 2.0 ** np.floor(np.log2(size)) if size > 0 else 0.0
    return np.round(middle / step) * step if step else middle


def subtract_origin(splats: Splats, origin: np.ndarray) -> np.ndarray:
    """Return the positions (N, 3) relative to `origin` as float32.

    Raises:
        HyrfDataError: a position is beyond the range of float32.
    """
    with np.errstate(over="ignore"):
        positions = (splats.positions - origin).astype(np.float32)
    if not np.isfinite(positions).all():
        raise HyrfDataError("positions are beyond the range of float32", fix="scale the scene down")
    return positions


def apply_transform(splats: Splats, matrix: np.ndarray, turn: np.ndarray, name: str) -> Splats:
    """Apply a transform of the scene graph to splats, followed by a rotation about the origin.

    Args:
        splats: the splats as stored in the file.
        matrix: (4, 4) float64 for column vectors: a rotation, a uniform scale and a translation.
        turn: (3, 3) rotation that is applied last.
        name: the file's name in error messages.

    Raises:
        HyrfDataError: the transform mirrors, skews or scales axes differently, or makes a number infinite.
    """
    scale, rotation = decompose_similarity(matrix, name)
    rotation = turn @ rotation
    if not np.allclose(rotation, np.eye(3), rtol=0, atol=1e-12):
        splats = splats.rotated(rotation)
    try:
        with np.errstate(over="ignore"):
            return Splats(
                splats.positions * scale + turn @ matrix[:3, 3],
                splats.scales * np.float32(scale),
                splats.quats,
                splats.opacities,
                splats.harmonics,
                splats.antialiased,
            )
    except ValueError as error:
        raise HyrfDataError(f"{name}: after its transform, {error}", fix="correct the transform") from error


def decompose_similarity(matrix: np.ndarray, name: str) -> tuple[float, np.ndarray]:
    """Return the uniform scale and the rotation (3, 3) of a transform (4, 4).

    Raises:
        HyrfDataError: the transform mirrors, skews or scales axes differently.
    """
    linear = matrix[:3, :3]
    scale = float(np.cbrt(np.linalg.det(linear))) if np.isfinite(matrix).all() else 0.0
    if scale > 0:
        u, _, vt = np.linalg.svd(linear / scale)
        if np.allclose(u @ vt, linear / scale, rtol=0, atol=1e-4):
            return scale, u @ vt
    raise HyrfDataError(
        f"{name}: the transform of its splats mirrors, skews or scales axes differently",
        fix="apply it to the splats before the export",
    )


def _compute_shortest_rotation(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return the shortest rotation between unit vectors that are not opposite, by Rodrigues' formula."""
    x, y, z = np.cross(start, end)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + cross + cross @ cross / (1 + start @ end)

"""Where files that have a scene graph (glTF, USD) place splats: upright, and near their own origin.

Such a file keeps the splats in the input's axes. A transform beside them turns the scene upright and carries what
float32 positions cannot: how far it lies from the origin.
"""

from __future__ import annotations

import numpy as np

from hyrfpack.errors import HyrfDataError
from hyrfpack.splats.splats import Splats

# Beyond so many times its own size from the origin a scene gets an origin of its own: float32 still tells apart
# 1/2,000,000 of the scene's size there.
_FAR = 8


def upright_rotation(up: np.ndarray, to: np.ndarray) -> np.ndarray:
    """(3, 3) rotation that takes `up` to `to`.

    Where they point apart, the half turn about x comes first, as between the axes of OpenCV and OpenGL: the shortest
    turn alone would face another way with every little change of `up`.

    Args:
        up: (3,) which way is up in the scene.
        to: (3,) which way is up in the file: +y or +z. Both unit vectors.
    """
    up, to = (np.asarray(vector, np.float64) for vector in (up, to))
    if up @ to < 0:
        half_turn = np.diag([1.0, -1.0, -1.0])
        return _shortest_turn(half_turn @ up, to) @ half_turn
    return _shortest_turn(up, to)


def local_origin(positions: np.ndarray) -> np.ndarray:
    """(3,) float64: the point that positions are to be stored relative to, so that float32 holds them well.

    The world's origin, unless the scene is far from it compared to its size; then a round number near its middle.

    Args:
        positions: (N, 3), world units.
    """
    if not len(positions):
        return np.zeros(3)
    middle = np.median(positions, axis=0)
    size = np.median(np.abs(positions - middle), axis=0).max()
    if np.abs(middle).max() <= _FAR * size:
        return np.zeros(3)
    step = 2.0 ** np.floor(np.log2(size)) if size > 0 else 0.0
    return np.round(middle / step) * step if step else middle


def local_positions(splats: Splats, origin: np.ndarray) -> np.ndarray:
    """(N, 3) float32 positions relative to `origin`.

    Raises:
        HyrfDataError: float32 cannot hold them.
    """
    with np.errstate(over="ignore"):
        positions = (splats.positions - origin).astype(np.float32)
    if not np.isfinite(positions).all():
        raise HyrfDataError("positions are beyond the range of float32; scale the scene down")
    return positions


def placed(splats: Splats, matrix: np.ndarray, turn: np.ndarray, name: str) -> Splats:
    """Splats as a transform moves them, turned afterwards.

    Args:
        splats: as the file holds them.
        matrix: (4, 4) float64, column vectors: a rotation, a uniform scale and a translation.
        turn: (3, 3) rotation to follow.
        name: what error messages call the file.

    Raises:
        HyrfDataError: the transform is another.
    """
    scale, rotation = rotation_of(matrix, name)
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
        raise HyrfDataError(f"{name}: moved as its transform says, {error}; correct the transform") from error


def rotation_of(matrix: np.ndarray, name: str) -> tuple[float, np.ndarray]:
    """The uniform scale and the (3, 3) rotation in a transform (4, 4). Raises HyrfDataError when there are none."""
    linear = matrix[:3, :3]
    scale = float(np.cbrt(np.linalg.det(linear))) if np.isfinite(matrix).all() else 0.0
    if scale > 0:
        u, _, vt = np.linalg.svd(linear / scale)
        if np.allclose(u @ vt, linear / scale, rtol=0, atol=1e-4):
            return scale, u @ vt
    raise HyrfDataError(
        f"{name}: the transform of its splats mirrors, skews or scales axes differently; apply it to them first"
    )


def matrices_of(quats: np.ndarray) -> np.ndarray:
    """(N, 3, 3) rotations of unit quaternions (N, 4) wxyz, in their precision."""
    w, x, y, z = quats.T
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, axis=1) for row in rows], axis=1)


def _shortest_turn(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Rodrigues' formula for unit vectors that do not point apart."""
    x, y, z = np.cross(start, end)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + cross + cross @ cross / (1 + start @ end)

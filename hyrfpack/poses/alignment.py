"""Align two reconstructions of the same photos by a robust similarity transform, and compare their camera poses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

# Two poses of a camera agree if their positions differ by at most this ratio of the extent, and their rotations by at
# most this angle.
MAX_POSITION_DIFFERENCE_RATIO = 0.02
MAX_ROTATION_DIFFERENCE_DEGREES = 5.0
_MAX_CANDIDATE_PAIRS = 4000  # each sampled pair of cameras yields one candidate similarity
_MAX_REFINEMENT_ROUNDS = 20

Poses = Mapping[str, np.ndarray]  # (3, 4) camera_from_world by photo name


@dataclass(frozen=True, eq=False)
class PoseAlignment:
    """Alignment of reconstruction a to reconstruction b, and the remaining differences of the camera poses.

    Attributes:
        names: names of the N photos posed in both, sorted.
        distance: (N,) distances between the aligned positions of each camera, as a ratio of the extent of b.
        angle: (N,) angles between the aligned rotations of each camera, in degrees.
        scale, rotation, shift: the similarity x_b = scale * rotation @ x_a + shift.
    """

    names: list[str]
    distance: np.ndarray
    angle: np.ndarray
    scale: float = 1.0
    rotation: np.ndarray | None = None
    shift: np.ndarray | None = None

    @property
    def agreeing(self) -> frozenset[str]:
        """Return the photos whose poses agree; none if fewer than three do, because any two cameras can be aligned."""
        agree = _agreement_mask(self.distance, self.angle)
        return frozenset(np.array(self.names)[agree].tolist()) if agree.sum() > 2 else frozenset()


def _agreement_mask(distance: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Return which poses agree (N,) bool, by the differences of `PoseAlignment`."""
    return (distance <= MAX_POSITION_DIFFERENCE_RATIO) & (angle <= MAX_ROTATION_DIFFERENCE_DEGREES)


def camera_positions(poses: Poses) -> np.ndarray:
    """Return the positions of the cameras, sorted by photo name: (N, 3)."""
    matrices = np.array([poses[name] for name in sorted(poses)]).reshape(-1, 3, 4)
    return -np.einsum("nji,nj->ni", matrices[:, :, :3], matrices[:, :, 3])


def camera_extent(poses: Poses) -> float:
    """Return the diagonal of the box around the cameras; for 20 or more, without the outer 5 % along each axis."""
    positions = camera_positions(poses)
    if len(positions) < 2:
        return 0.0
    low, high = (
        (positions.min(0), positions.max(0)) if len(positions) < 20 else np.percentile(positions, (2.5, 97.5), axis=0)
    )
    return float(np.linalg.norm(high - low))


def align_poses(a: Poses, b: Poses) -> PoseAlignment:
    """Align reconstruction `a` to `b` so that as many cameras as possible agree.

    A candidate similarity is computed from each pair of cameras; its rotation comes from the camera rotations, so
    cameras on a line suffice. The candidate with the most agreeing cameras is refined on them by least squares over
    positions and rotations.

    Args:
        a, b: poses by photo name; any of them may be wrong.

    Returns:
        The alignment, over the photos that both have.
    """
    names = sorted(set(a) & set(b))
    extent = camera_extent(b)
    if len(names) < 2 or extent <= 0:
        return PoseAlignment(names, np.full(len(names), np.inf), np.full(len(names), 180.0))
    rotations_a, rotations_b = (np.array([poses[name][:, :3] for name in names]) for poses in (a, b))
    positions_a, positions_b = (camera_positions({name: poses[name] for name in names}) for poses in (a, b))
    relative_rotations = np.einsum("nji,njk->nik", rotations_b, rotations_a)  # (N, 3, 3), one for each camera

    def differences(scale: float, rotation: np.ndarray, shift: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the distances and angles of `PoseAlignment` after a similarity transform."""
        distance = np.linalg.norm(scale * positions_a @ rotation.T + shift - positions_b, axis=1) / extent
        cosine = (np.einsum("nij,ij->n", relative_rotations, rotation) - 1) / 2
        return distance, np.degrees(np.arccos(np.clip(cosine, -1, 1)))

    def score(similarity: tuple[float, np.ndarray, np.ndarray]) -> float:
        """Return the number of agreeing cameras, each weighted by how closely it agrees (MSAC)."""
        distance, angle = differences(*similarity)
        closeness = (
            1 - (distance / MAX_POSITION_DIFFERENCE_RATIO) ** 2 / 2 - (angle / MAX_ROTATION_DIFFERENCE_DEGREES) ** 2 / 2
        )
        return float(closeness[_agreement_mask(distance, angle)].sum())

    best, best_score = (1.0, np.eye(3), np.zeros(3)), -1.0
    for i, j in _sample_camera_pairs(len(names)):
        length = np.linalg.norm(positions_a[j] - positions_a[i])
        if length <= 0:
            continue
        rotation = nearest_rotation(relative_rotations[i] + relative_rotations[j])
        scale = float(np.linalg.norm(positions_b[j] - positions_b[i]) / length)
        shift = (positions_b[i] + positions_b[j] - scale * rotation @ (positions_a[i] + positions_a[j])) / 2
        candidate = (scale, rotation, shift)
        if (candidate_score := score(candidate)) > best_score:
            best, best_score = candidate, candidate_score
    for _ in range(_MAX_REFINEMENT_ROUNDS):
        agree = _agreement_mask(*differences(*best))
        if agree.sum() < 2:
            break
        candidate = _fit_similarity(
            positions_a[agree], positions_b[agree], relative_rotations[agree], MAX_POSITION_DIFFERENCE_RATIO * extent
        )
        if (candidate_score := score(candidate)) <= best_score:
            break
        best, best_score = candidate, candidate_score
    distance, angle = differences(*best)
    return PoseAlignment(names, distance, angle, *best)


def _sample_camera_pairs(count: int) -> np.ndarray:
    """Return all pairs of cameras, or a random sample if there are too many: (pairs, 2)."""
    pairs = count * (count - 1) // 2
    if pairs > _MAX_CANDIDATE_PAIRS:
        chosen = np.random.default_rng(0).choice(pairs, _MAX_CANDIDATE_PAIRS, replace=False)
    else:
        chosen = np.arange(pairs)
    # Pairs are numbered (0, 1), (0, 2), ... (1, 2), ...; camera i is the first of count - 1 - i pairs.
    firsts = np.arange(count)
    starts = firsts * (2 * count - firsts - 1) // 2
    first = np.searchsorted(starts, chosen, side="right") - 1
    return np.stack([first, chosen - starts[first] + first + 1], axis=1)


def _fit_similarity(
    a: np.ndarray, b: np.ndarray, relative_rotations: np.ndarray, position_unit: float
) -> tuple[float, np.ndarray, np.ndarray]:
    """Fit a similarity by least squares over positions (Umeyama 1991) and rotations, weighted by their tolerances."""
    mean_a, mean_b = a.mean(0), b.mean(0)
    from_a, from_b = a - mean_a, b - mean_b
    scale = float(np.sqrt((from_b**2).sum() / max((from_a**2).sum(), 1e-300)))
    rotations = relative_rotations.sum(0) / (2 * np.radians(MAX_ROTATION_DIFFERENCE_DEGREES) ** 2)
    rotation = nearest_rotation(scale * from_b.T @ from_a / position_unit**2 + rotations)
    scale = float((from_b * (from_a @ rotation.T)).sum() / max((from_a**2).sum(), 1e-300))
    return scale, rotation, mean_b - scale * rotation @ mean_a


def nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """Return the rotation R that maximises tr(R^T M)."""
    left, _, right = np.linalg.svd(matrix)
    return left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right

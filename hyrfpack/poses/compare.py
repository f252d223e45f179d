"""How far two reconstructions of the same photos agree: a robust similarity between their cameras."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

NEAR = 0.02  # of the extent: how far apart two places of one camera may be to count as the same
TURN = 5.0  # degrees: and how far apart its two directions
_TRIALS = 4000  # pairs of cameras that a similarity is guessed from, at most
_ROUNDS = 20  # of refining it

Poses = Mapping[str, np.ndarray]  # by photo: (3, 4) camera_from_world


@dataclass(frozen=True, eq=False)
class Agreement:
    """Where two reconstructions agree.

    Attributes:
        names: photos posed in both, sorted.
        distance: (N,) between the places of each after alignment, in extents of the second.
        angle: (N,) degrees between its directions.
        scale, rotation, shift: the similarity x_b = scale * rotation @ x_a + shift.
    """

    names: list[str]
    distance: np.ndarray
    angle: np.ndarray
    scale: float = 1.0
    rotation: np.ndarray | None = None
    shift: np.ndarray | None = None

    @property
    def same(self) -> frozenset[str]:
        """Photos whose poses agree: within NEAR of the extent and TURN degrees. Two cameras always do: none of two."""
        agree = (self.distance <= NEAR) & (self.angle <= TURN)
        return frozenset(np.array(self.names)[agree].tolist()) if agree.sum() > 2 else frozenset()


def centres(poses: Poses) -> np.ndarray:
    """(N, 3) places of the cameras, sorted by name."""
    matrices = np.array([poses[name] for name in sorted(poses)]).reshape(-1, 3, 4)
    return -np.einsum("nji,nj->ni", matrices[:, :, :3], matrices[:, :, 3])


def extent(poses: Poses) -> float:
    """Length of the diagonal of the box around the cameras, but for the farthest twentieth in each direction."""
    places = centres(poses)
    if len(places) < 2:
        return 0.0
    low, high = (places.min(0), places.max(0)) if len(places) < 20 else np.percentile(places, (2.5, 97.5), axis=0)
    return float(np.linalg.norm(high - low))


def compare(a: Poses, b: Poses) -> Agreement:
    """Align reconstruction `a` to `b` so that as many cameras as possible agree.

    The similarity with the most cameras that agree among those guessed from two cameras each (their rotations give its
    rotation, so that cameras on a line will do), refined on these by least squares over places and directions.

    Args:
        a, b: poses by photo; any of them may be wrong.

    Returns:
        The agreement, over photos that both have.
    """
    names = sorted(set(a) & set(b))
    size = extent(b)
    if len(names) < 2 or size <= 0:
        return Agreement(names, np.full(len(names), np.inf), np.full(len(names), 180.0))
    turns_a, turns_b = (np.array([poses[name][:, :3] for name in names]) for poses in (a, b))
    places_a, places_b = (centres({name: poses[name] for name in names}) for poses in (a, b))
    between = np.einsum("nji,njk->nik", turns_b, turns_a)  # each camera's own guess of the rotation

    def errors(scale: float, rotation: np.ndarray, shift: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        distance = np.linalg.norm(scale * places_a @ rotation.T + shift - places_b, axis=1) / size
        cosine = (np.einsum("nij,ij->n", between, rotation) - 1) / 2
        return distance, np.degrees(np.arccos(np.clip(cosine, -1, 1)))

    def score(guess: tuple[float, np.ndarray, np.ndarray]) -> float:
        """How many cameras agree; those that nearly fit count nearly (MSAC)."""
        distance, angle = errors(*guess)
        nearly = 1 - (distance / NEAR) ** 2 / 2 - (angle / TURN) ** 2 / 2
        return float(nearly[fits(distance, angle)].sum())

    def fits(distance: np.ndarray, angle: np.ndarray) -> np.ndarray:
        return (distance <= NEAR) & (angle <= TURN)

    best, best_score = (1.0, np.eye(3), np.zeros(3)), -1.0
    for i, j in _pairs(len(names)):
        length = np.linalg.norm(places_a[j] - places_a[i])
        if length <= 0:
            continue
        rotation = _nearest_rotation(between[i] + between[j])
        scale = float(np.linalg.norm(places_b[j] - places_b[i]) / length)
        shift = (places_b[i] + places_b[j] - scale * rotation @ (places_a[i] + places_a[j])) / 2
        guess = (scale, rotation, shift)
        if (found := score(guess)) > best_score:
            best, best_score = guess, found
    for _ in range(_ROUNDS):
        inside = fits(*errors(*best))
        if inside.sum() < 2:
            break
        guess = _fit(places_a[inside], places_b[inside], between[inside], NEAR * size)
        if (found := score(guess)) <= best_score:
            break
        best, best_score = guess, found
    distance, angle = errors(*best)
    return Agreement(names, distance, angle, *best)


def _pairs(count: int) -> np.ndarray:
    first, second = np.triu_indices(count, 1)
    if len(first) > _TRIALS:
        chosen = np.random.default_rng(0).choice(len(first), _TRIALS, replace=False)
        first, second = first[chosen], second[chosen]
    return np.stack([first, second], axis=1)


def _fit(a: np.ndarray, b: np.ndarray, between: np.ndarray, near: float) -> tuple[float, np.ndarray, np.ndarray]:
    """Least squares over places (Umeyama 1991) and rotations, each weighed by what counts as the same."""
    mean_a, mean_b = a.mean(0), b.mean(0)
    from_a, from_b = a - mean_a, b - mean_b
    scale = float(np.sqrt((from_b**2).sum() / max((from_a**2).sum(), 1e-300)))
    turns = between.sum(0) / (2 * np.radians(TURN) ** 2)
    rotation = _nearest_rotation(scale * from_b.T @ from_a / near**2 + turns)
    scale = float((from_b * (from_a @ rotation.T)).sum() / max((from_a**2).sum(), 1e-300))
    return scale, rotation, mean_b - scale * rotation @ mean_a


def _nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """argmax of tr(R^T M) over rotations."""
    left, _, right = np.linalg.svd(matrix)
    return left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right

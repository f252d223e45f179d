"""Which photos are matched with which."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

EXHAUSTIVE_UP_TO = 200  # photos of an unordered set: beyond, only those that look alike are matched
_WORDS = 64  # of the vocabulary that photos are summed up by
_SAMPLE = 50_000  # descriptors that it is made from
_ROUNDS = 12  # of k-means
_ALIKE, _BESIDE = 40, 5  # unordered: the most similar photos, and the neighbours by name on each side
_AHEAD, _LOOPS = 10, 8  # ordered: the next photos, and the most similar ones that are farther away

Pairs = list[tuple[int, int]]


def choose_matching(count: int, ordered: bool) -> str:
    """ "exhaustive", "sequential" or "retrieval", by what a set is."""
    if ordered:
        return "sequential"
    return "exhaustive" if count <= EXHAUSTIVE_UP_TO else "retrieval"


def exhaustive(count: int) -> Pairs:
    """All pairs, those of near names first."""
    return [(first, first + step) for step in range(1, count) for first in range(count - step)]


def sequential(count: int, similarity: np.ndarray) -> Pairs:
    """Each photo with the next ten and those 16, 32, 64 ... later, and with those that look alike wherever they are.

    Args:
        count: photos.
        similarity: (count, count), from `similarities`.
    """
    steps = [*range(1, _AHEAD + 1), *(2**power for power in range(4, 12))]
    pairs = {(first, first + step) for step in steps for first in range(count - step)}
    far = np.abs(np.subtract.outer(np.arange(count), np.arange(count))) > _AHEAD
    return sorted(pairs | _most_alike(np.where(far, similarity, -np.inf), _LOOPS))


def retrieval(count: int, similarity: np.ndarray) -> Pairs:
    """Each photo with those that look most like it, and with its neighbours by name."""
    beside = {(first, first + step) for step in range(1, _BESIDE + 1) for first in range(count - step)}
    return sorted(beside | _most_alike(similarity, _ALIKE))


def _most_alike(similarity: np.ndarray, most: int) -> set[tuple[int, int]]:
    pairs = set()
    for photo, row in enumerate(similarity):
        row = row.copy()
        row[photo] = -np.inf
        for other in np.argsort(-row, kind="stable")[:most]:
            if np.isfinite(row[other]):
                pairs.add((min(photo, int(other)), max(photo, int(other))))
    return pairs


def similarities(
    descriptors: list[np.ndarray], seed: int, progress: Callable[[int], None] = lambda done: None
) -> np.ndarray:
    """How alike photos are, by what their features look like (VLAD, Jegou et al. 2010).

    A vocabulary is made from the set itself; each photo is the sum of what its descriptors differ by from their nearest
    words, normalised word by word (Arandjelovic and Zisserman 2013) and as a whole.

    Args:
        descriptors: (N, 128) uint8 of each photo; N may be 0.
        seed: of the sample and of where k-means starts.
        progress: called with the number of photos that are done.

    Returns:
        (photos, photos) cosines in [-1, 1]; 0 for photos without features.
    """
    rng = np.random.default_rng(seed)
    share = max(1, _SAMPLE // max(len(descriptors), 1))
    sample = [found[rng.permutation(len(found))[:share]] for found in descriptors]
    words = _k_means(np.concatenate(sample).astype(np.float32), rng)
    sums = np.zeros((len(descriptors), *words.shape), np.float32)
    for photo, found in enumerate(descriptors):
        if len(found):
            values = found.astype(np.float32)
            nearest = _nearest(values, words)
            np.add.at(sums[photo], nearest, values - words[nearest])
        progress(photo + 1)
    sums /= np.maximum(np.linalg.norm(sums, axis=2, keepdims=True), 1e-6)
    flat = sums.reshape(len(sums), -1)
    flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-6)
    return flat @ flat.T


def _k_means(values: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(words, 128) centres; where there are fewer values than words, the values."""
    words = values[rng.permutation(len(values))[:_WORDS]]
    for _ in range(_ROUNDS):
        nearest = _nearest(values, words)
        sums = np.zeros_like(words)
        np.add.at(sums, nearest, values)
        counts = np.bincount(nearest, minlength=len(words))[:, None]
        words = np.where(counts > 0, sums / np.maximum(counts, 1), words)
    return words


def _nearest(values: np.ndarray, words: np.ndarray) -> np.ndarray:
    """(N,) index of the word nearest to each value."""
    return np.argmin((words**2).sum(1) - 2 * values @ words.T, axis=1)

"""Choose which pairs of photos are matched."""

from __future__ import annotations

import numpy as np

from hyrfpack.progress import Progress, TaskEvent, ignore_progress

MAX_EXHAUSTIVE_PHOTOS = 60  # in larger unordered sets, only similar photos are matched
_VOCABULARY_WORDS = 64
_VOCABULARY_SAMPLE_DESCRIPTORS = 50_000
_KMEANS_ITERATIONS = 12
# Partners of a photo in an unordered set: similar photos, more of them in larger sets, and neighbours by name on each
# side.
_RETRIEVAL_SIMILAR_RATIO = 0.2
_MIN_RETRIEVAL_SIMILAR_PHOTOS, _MAX_RETRIEVAL_SIMILAR_PHOTOS = 20, 40
_RETRIEVAL_NEIGHBOURS = 5
# Partners of a photo in a sequence: the next photos, and similar ones farther away, which close loops.
_SEQUENTIAL_NEIGHBOURS = 10
_LOOP_CLOSURE_PHOTOS = 8

Pairs = list[tuple[int, int]]


def choose_matching(count: int, ordered: bool) -> str:
    """Return "exhaustive", "sequential" or "retrieval", by the number of photos and whether they form a sequence."""
    if ordered:
        return "sequential"
    return "exhaustive" if count <= MAX_EXHAUSTIVE_PHOTOS else "retrieval"


def exhaustive_pairs(count: int) -> Pairs:
    """Return all pairs, those of photos with neighbouring names first."""
    return [(first, first + step) for step in range(1, count) for first in range(count - step)]


def sequential_pairs(count: int, similarity: np.ndarray) -> Pairs:
    """Pair each photo of a sequence with the next ten, those 16, 32, 64 ... later, and the most similar distant ones.

    Args:
        count: number of photos.
        similarity: (count, count) matrix from `compute_similarities`.
    """
    steps = [*range(1, _SEQUENTIAL_NEIGHBOURS + 1), *(2**power for power in range(4, 12))]
    pairs = {(first, first + step) for step in steps for first in range(count - step)}
    return sorted(
        pairs | _most_similar_pairs(similarity, _LOOP_CLOSURE_PHOTOS, min_distance=_SEQUENTIAL_NEIGHBOURS + 1)
    )


def retrieval_pairs(count: int, similarity: np.ndarray) -> Pairs:
    """Pair each photo of an unordered set with the most similar fifth, 20 to 40, and with its neighbours by name."""
    similar = round(_RETRIEVAL_SIMILAR_RATIO * count)
    similar = min(max(similar, _MIN_RETRIEVAL_SIMILAR_PHOTOS), _MAX_RETRIEVAL_SIMILAR_PHOTOS)
    neighbours = {
        (first, first + step) for step in range(1, _RETRIEVAL_NEIGHBOURS + 1) for first in range(count - step)
    }
    return sorted(neighbours | _most_similar_pairs(similarity, similar))


def _most_similar_pairs(similarity: np.ndarray, max_partners: int, min_distance: int = 1) -> set[tuple[int, int]]:
    """Pair each photo with its `max_partners` most similar photos at least `min_distance` places away in the order."""
    pairs = set()
    for photo, row in enumerate(similarity):
        row = row.copy()
        row[max(0, photo - min_distance + 1) : photo + min_distance] = -np.inf
        for other in np.argsort(-row, kind="stable")[:max_partners]:
            if np.isfinite(row[other]):
                pairs.add((min(photo, int(other)), max(photo, int(other))))
    return pairs


def compute_similarities(descriptors: list[np.ndarray], seed: int, progress: Progress = ignore_progress) -> np.ndarray:
    """Compute the similarity of each pair of photos from their feature descriptors (VLAD, Jegou et al. 2010).

    The vocabulary is learned from the set itself. The vector of a photo sums the differences between its descriptors
    and their nearest words. It is normalised for each word (Arandjelovic and Zisserman 2013) and as a whole.

    Args:
        descriptors: (N, 128) uint8 descriptors of each photo; N may be 0.
        seed: random seed of the descriptor sample and of k-means.
        progress: called with a `TaskEvent` after each photo.

    Returns:
        (photos, photos) cosines in [-1, 1]; 0 for photos without features.
    """
    rng, count = np.random.default_rng(seed), len(descriptors)
    sample_per_photo = max(1, _VOCABULARY_SAMPLE_DESCRIPTORS // max(count, 1))
    sample = [own[rng.permutation(len(own))[:sample_per_photo]] for own in descriptors]
    words = _k_means(np.concatenate(sample).astype(np.float32), rng)
    sums = np.zeros((count, *words.shape), np.float32)
    for photo, own in enumerate(descriptors):
        if len(own):
            values = own.astype(np.float32)
            nearest = _nearest_words(values, words)
            np.add.at(sums[photo], nearest, values - words[nearest])
        progress(TaskEvent(f"choosing pairs to match, photo {photo + 1}/{count}", (photo + 1) / count))
    sums /= np.maximum(np.linalg.norm(sums, axis=2, keepdims=True), 1e-6)
    flat = sums.reshape(len(sums), -1)
    flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-6)
    return flat @ flat.T


def _k_means(values: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return (words, 128) k-means centres, or the values themselves if there are at most as many as words."""
    words = values[rng.permutation(len(values))[:_VOCABULARY_WORDS]]
    for _ in range(_KMEANS_ITERATIONS):
        nearest = _nearest_words(values, words)
        sums = np.zeros_like(words)
        np.add.at(sums, nearest, values)
        counts = np.bincount(nearest, minlength=len(words))[:, None]
        words = np.where(counts > 0, sums / np.maximum(counts, 1), words)
    return words


def _nearest_words(values: np.ndarray, words: np.ndarray) -> np.ndarray:
    """Return the index of the word nearest to each value: (N,)."""
    return np.argmin((words**2).sum(1) - 2 * values @ words.T, axis=1)

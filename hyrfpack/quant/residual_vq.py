"""Residual vector quantisation: each row is approximated by the sum of one codeword of each stage's codebook."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hyrfpack.quant.errors import DamagedDataError

_MAX_TRAINING_ROWS = 100_000
_MAX_SEEDING_ROWS = 16_384
_MAX_PRODUCTS_PER_CHUNK = 1 << 18  # BLAS computes a matrix product this small in one thread, see `_nearest_centers`.
# By dtype of the codebooks; differences of values then stay finite.
_MAX_ABS_VALUE = {"float32": 1e30, "float16": 65504.0}


@dataclass(frozen=True)
class ResidualVectorQuantizer:
    """Quantises rows of D numbers in stages; each stage codes the residual of the previous stages.

        r_0 = v      i_s = argmin_k |(r_s - c_s[k]) / sigma|      r_s+1 = r_s - c_s[i_s]      decoded: sum_s c_s[i_s]

    sigma is the standard deviation of each column (at least the resolution of `codebook_dtype`), so that columns of
    different scale have the same weight. k-means on up to 100,000 rows gives the codebooks. Their codewords are then
    replaced by the means over all rows and rounded as they will be stored. Finally every row is assigned to the
    codewords that a decoder will have.

    A stage never increases the mean over rows of |error / sigma|^2 (up to float32 rounding). The mean of a cluster,
    even rounded to the nearest storable number, leaves no larger error than a codeword of zero. The final assignment
    only lowers the error.

    The same values and settings give the same result on the same machine.

    Attributes:
        stages: S, number of codewords that are added up for a row, 1 or more.
        codebook_size: K, codewords per stage, 1 to 65536.
        codebook_dtype: precision of stored codebooks, "float32" or "float16". Codebooks are always returned as
            float32; with "float16" they hold only numbers that float16 can represent.
        iterations: largest number of k-means iterations; it stops earlier when the assignment no longer changes.
        seed: random seed for the choice of training rows and initial centres.
    """

    stages: int = 6
    codebook_size: int = 64
    codebook_dtype: str = "float32"
    iterations: int = 20
    seed: int = 0

    def __post_init__(self) -> None:
        if self.stages < 1 or not 1 <= self.codebook_size <= 65536 or self.iterations < 0:
            raise ValueError(f"{self}: needs 1 stage or more, 1 to 65536 codewords and no negative iterations")
        if self.codebook_dtype not in ("float32", "float16"):
            raise ValueError(f"codebook_dtype must be 'float32' or 'float16', got '{self.codebook_dtype}'")

    def encode(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Compute codebooks for the rows, and encode the rows.

        Args:
            values: (N, D) finite floats, N >= 0, D >= 1.

        Returns:
            (N, S) indices, uint8 for up to 256 codewords, else uint16; and (S, K, D) float32 codebooks. Codewords that
            are not needed equal another codeword or are zero.

        Raises:
            ValueError: a value is NaN, infinite, or larger than 1e30 (float32) or 65504 (float16).
        """
        if values.ndim != 2 or values.shape[1] == 0:
            raise ValueError(f"values must be (N, D) with D >= 1, got {values.shape}")
        largest = _MAX_ABS_VALUE[self.codebook_dtype]
        if not (np.abs(values) <= largest).all():
            raise ValueError(
                f"residual VQ: a value is NaN or beyond +-{largest:g}, the range of {self.codebook_dtype} codebooks; "
                "check what the values come from"
            )
        rows, dims = values.shape
        indices = np.zeros((rows, self.stages), np.uint8 if self.codebook_size <= 256 else np.uint16)
        codebooks = np.zeros((self.stages, self.codebook_size, dims), np.float32)
        if rows == 0:
            return indices, codebooks

        residual = values.astype(np.float32)
        stored = np.finfo(self.codebook_dtype)
        resolution = np.maximum(np.abs(residual).max(axis=0) * stored.eps, stored.smallest_subnormal)
        sigma = np.maximum(residual.std(axis=0, dtype=np.float64), resolution)
        weights = 1 / sigma
        rng = np.random.default_rng(self.seed)
        for stage in range(self.stages):
            indices[:, stage], codebooks[stage] = self._encode_stage(residual, weights, rng)
            residual -= codebooks[stage, indices[:, stage]]
        return indices, codebooks

    @staticmethod
    def decode(indices: np.ndarray, codebooks: np.ndarray) -> np.ndarray:
        """Decode rows: add up their codewords in float32, stage after stage.

        Args:
            indices: (N, S) unsigned integers.
            codebooks: (S, K, D) floats.

        Returns:
            (N, D) float32.

        Raises:
            DamagedDataError: the numbers of stages differ, or an index is K or more.
        """
        if indices.ndim != 2 or codebooks.ndim != 3 or indices.shape[1] != codebooks.shape[0]:
            raise DamagedDataError(
                f"residual VQ: indices {indices.shape} and codebooks {codebooks.shape} disagree; the data is damaged"
            )
        if indices.max(initial=0) >= codebooks.shape[1] and indices.size:
            raise DamagedDataError(
                f"residual VQ: index {indices.max()} in a codebook of {codebooks.shape[1]}; the data is damaged"
            )
        decoded = np.zeros((len(indices), codebooks.shape[2]), np.float32)
        for stage, codebook in enumerate(codebooks.astype(np.float32)):
            decoded += codebook[indices[:, stage]]
        return decoded

    def _encode_stage(
        self, residual: np.ndarray, weights: np.ndarray, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """Compute indices (N,) and codebook (K, D) of one stage for the residual (N, D)."""
        # Rows are centred before scaling, because float32 scores far from zero would not resolve differences.
        center = residual.mean(axis=0, dtype=np.float64)

        def scaled(points: np.ndarray) -> np.ndarray:
            return ((points - center) * weights).astype(np.float32)

        points = scaled(residual)
        sample = points
        if len(points) > _MAX_TRAINING_ROWS:
            sample = points[np.sort(rng.permutation(len(points))[:_MAX_TRAINING_ROWS])]
        centers = _kmeans(sample, self.codebook_size, self.iterations, rng)
        codebook = _cluster_means(residual, _nearest_centers(points, centers), self.codebook_size)
        largest = _MAX_ABS_VALUE[self.codebook_dtype]
        codebook = np.clip(codebook, -largest, largest).astype(self.codebook_dtype).astype(np.float32)
        return _nearest_centers(points, scaled(codebook)), codebook


def _kmeans(points: np.ndarray, clusters: int, iterations: int, rng: np.random.Generator) -> np.ndarray:
    """Return the centres (K, D) float32 of Lloyd's iteration from a k-means++ start.

    Empty clusters move to the rows with the largest error.
    """
    seeds = points if len(points) <= _MAX_SEEDING_ROWS else points[rng.permutation(len(points))[:_MAX_SEEDING_ROWS]]
    centers = _choose_initial_centers(seeds, clusters, rng)
    labels = None
    for _ in range(iterations):
        before, labels = labels, _nearest_centers(points, centers)
        if before is not None and np.array_equal(before, labels):
            break
        centers = _cluster_means(points, labels, clusters).astype(np.float32)
        empty = np.flatnonzero(np.bincount(labels, minlength=clusters) == 0)
        if len(empty):
            error = ((points - centers[labels]) ** 2).sum(axis=1)
            worst = np.argsort(-error, kind="stable")[: len(empty)]
            centers[empty[: len(worst)]] = points[worst]
    return centers


def _choose_initial_centers(points: np.ndarray, clusters: int, rng: np.random.Generator) -> np.ndarray:
    """Choose initial centres by k-means++.

    Each further centre is a row, drawn with probability proportional to its squared distance from the nearest centre.
    """
    columns = np.ascontiguousarray(points.T)
    centers = np.repeat(points[:1], clusters, axis=0)
    centers[0] = points[int(rng.random() * len(points))]
    distance = np.full(len(points), np.inf)
    for k in range(1, clusters):
        latest = sum((column - value) ** 2 for column, value in zip(columns, centers[k - 1], strict=True))
        distance = np.minimum(distance, latest)
        mass = np.cumsum(distance)
        if mass[-1] == 0:  # Every row is a centre already.
            centers[k:] = centers[0]
            break
        centers[k] = points[np.searchsorted(mass, rng.random() * mass[-1], side="right")]
    return centers


def _nearest_centers(points: np.ndarray, centers: np.ndarray) -> np.ndarray:
    """Return the index (N,) intp of the centre nearest to each row; the first one if several are equally near."""
    # |p - c|^2 is smallest where p . c - |c|^2 / 2 is largest.
    transposed = np.ascontiguousarray(centers.T)
    half_squares = 0.5 * (centers * centers).sum(axis=1)
    labels = np.empty(len(points), np.intp)
    # Products use one thread: waking others costs more than it saves on busy machines, and the results must not depend
    # on the number of threads.
    chunk = max(1, _MAX_PRODUCTS_PER_CHUNK // centers.size)
    for first in range(0, len(points), chunk):
        scores = points[first : first + chunk] @ transposed
        scores -= half_squares
        np.argmax(scores, axis=1, out=labels[first : first + chunk])
    return labels


def _cluster_means(points: np.ndarray, labels: np.ndarray, clusters: int) -> np.ndarray:
    """Return the mean (K, D) float64 of the rows of each label; zero for labels without rows."""
    counts = np.maximum(np.bincount(labels, minlength=clusters), 1)
    sums = [np.bincount(labels, weights=column, minlength=clusters) for column in points.T]
    return np.stack(sums, axis=1) / counts[:, None]

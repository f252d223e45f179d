"""Residual vector quantisation: each row is the sum of one codeword out of every stage's codebook."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hyrfpack.quant.errors import DamagedDataError

_TRAINING_ROWS = 100_000  # rows that k-means looks at
_SEEDING_ROWS = 16_384  # of these, rows that first centres are drawn from
_CHUNK_PRODUCTS = 1 << 18  # of one matrix product: small enough that BLAS leaves it to one thread (see _nearest)
_LARGEST = {"float32": 1e30, "float16": 65504.0}  # room left for differences


@dataclass(frozen=True)
class ResidualVectorQuantizer:
    """Quantises rows of D numbers in stages, each stage coding what the ones before left over.

        r_0 = v      i_s = argmin_k |(r_s - c_s[k]) / sigma|      r_s+1 = r_s - c_s[i_s]      decoded: sum_s c_s[i_s]

    sigma is the standard deviation of each column (no less than what `codebook_dtype` resolves), so that columns of
    different scale weigh alike. Codebooks come from k-means on up to 100,000 rows, are then moved to the means over
    all rows and rounded as they will be stored, and only then is every row assigned to what a decoder will have.

    The mean over rows of |error / sigma|^2 never grows with a stage (up to float32 rounding): the mean of a cluster,
    even rounded to the nearest storable number, leaves no more than coding nothing, and assigning anew only lowers it.

    The same values and settings give the same result on the same machine.

    Attributes:
        stages: S, codewords added up for a row, 1 or more.
        codebook_size: K, codewords of a stage, 1 to 65536.
        codebook_dtype: how codebooks are stored, "float32" or "float16". Codebooks are always handed over as float32;
            under "float16" they hold only numbers that float16 can.
        iterations: rounds of k-means, fewer if it settles earlier.
        seed: of the random choice of rows to train on and to start from.
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
        """Find codebooks for these rows and code the rows with them.

        Args:
            values: (N, D) finite floats, N >= 0, D >= 1.

        Returns:
            (N, S) indices, uint8 for up to 256 codewords, else uint16; and (S, K, D) float32 codebooks, in which
            codewords that are not needed repeat another or are zero.

        Raises:
            ValueError: a value is NaN, infinite, or larger than 1e30 (float32) or 65504 (float16).
        """
        if values.ndim != 2 or values.shape[1] == 0:
            raise ValueError(f"values must be (N, D) with D >= 1, got {values.shape}")
        largest = _LARGEST[self.codebook_dtype]
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
        """Add up the codewords, stage after stage, in float32.

        Args:
            indices: (N, S) unsigned integers.
            codebooks: (S, K, D) floats.

        Returns:
            (N, D) float32.

        Raises:
            DamagedDataError: the stages disagree, or an index is K or more.
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
        """Indices (N,) and codebook (K, D) for what is left over."""
        # Centred before scaling: far from zero, float32 scores would have no digits left for differences.
        center = residual.mean(axis=0, dtype=np.float64)

        def scaled(points: np.ndarray) -> np.ndarray:
            return ((points - center) * weights).astype(np.float32)

        points = scaled(residual)
        sample = points
        if len(points) > _TRAINING_ROWS:
            sample = points[np.sort(rng.permutation(len(points))[:_TRAINING_ROWS])]
        centers = _kmeans(sample, self.codebook_size, self.iterations, rng)
        codebook = _means(residual, _nearest(points, centers), self.codebook_size)
        largest = _LARGEST[self.codebook_dtype]
        codebook = np.clip(codebook, -largest, largest).astype(self.codebook_dtype).astype(np.float32)
        return _nearest(points, scaled(codebook)), codebook


def _kmeans(points: np.ndarray, clusters: int, iterations: int, rng: np.random.Generator) -> np.ndarray:
    """Centres (K, D) float32 of Lloyd's iteration from a k-means++ start; empty clusters move to the worst rows."""
    seeds = points if len(points) <= _SEEDING_ROWS else points[rng.permutation(len(points))[:_SEEDING_ROWS]]
    centers = _plus_plus(seeds, clusters, rng)
    labels = None
    for _ in range(iterations):
        before, labels = labels, _nearest(points, centers)
        if before is not None and np.array_equal(before, labels):
            break
        centers = _means(points, labels, clusters).astype(np.float32)
        empty = np.flatnonzero(np.bincount(labels, minlength=clusters) == 0)
        if len(empty):
            error = ((points - centers[labels]) ** 2).sum(axis=1)
            worst = np.argsort(-error, kind="stable")[: len(empty)]
            centers[empty[: len(worst)]] = points[worst]
    return centers


def _plus_plus(points: np.ndarray, clusters: int, rng: np.random.Generator) -> np.ndarray:
    """k-means++: each further centre is a row drawn with odds proportional to its squared distance from the nearest."""
    columns = np.ascontiguousarray(points.T)
    centers = np.repeat(points[:1], clusters, axis=0)
    centers[0] = points[int(rng.random() * len(points))]
    distance = np.full(len(points), np.inf)
    for k in range(1, clusters):
        latest = sum((column - value) ** 2 for column, value in zip(columns, centers[k - 1], strict=True))
        distance = np.minimum(distance, latest)
        mass = np.cumsum(distance)
        if mass[-1] == 0:  # every row is a centre already
            centers[k:] = centers[0]
            break
        centers[k] = points[np.searchsorted(mass, rng.random() * mass[-1], side="right")]
    return centers


def _nearest(points: np.ndarray, centers: np.ndarray) -> np.ndarray:
    """(N,) intp: the centre nearest to each row, the first of equals."""
    # |p - c|^2 is smallest where p . c - |c|^2 / 2 is largest.
    transposed = np.ascontiguousarray(centers.T)
    half_squares = 0.5 * (centers * centers).sum(axis=1)
    labels = np.empty(len(points), np.intp)
    # One thread: waking others costs more than it saves on busy machines, and results cannot depend on their number.
    chunk = max(1, _CHUNK_PRODUCTS // centers.size)
    for first in range(0, len(points), chunk):
        scores = points[first : first + chunk] @ transposed
        scores -= half_squares
        np.argmax(scores, axis=1, out=labels[first : first + chunk])
    return labels


def _means(points: np.ndarray, labels: np.ndarray, clusters: int) -> np.ndarray:
    """(K, D) float64: the mean of the rows with each label, zero for none."""
    counts = np.maximum(np.bincount(labels, minlength=clusters), 1)
    sums = [np.bincount(labels, weights=column, minlength=clusters) for column in points.T]
    return np.stack(sums, axis=1) / counts[:, None]

"""K-means palettes for rows of numbers, fast enough on a CPU for a million rows and thousands of entries."""

from __future__ import annotations

import numpy as np
import torch

from hyrfpack.parallel.pool import run_tasks

# A thread multiplies this many rows by this many entries at a time, so that the products (2 MB) stay in the cache.
_BLOCK_ROWS = 1024
_BLOCK_ENTRIES = 512
_SAMPLE_ROWS_PER_ENTRY = 16


def build_palette(rows: np.ndarray, weights: np.ndarray, size: int, rounds: int = 6) -> np.ndarray:
    """Build a palette by weighted k-means (Lloyd's algorithm).

    It minimises the sum over rows of weight times squared distance to the nearest entry. The first entries are rows
    sampled with probability proportional to their weights. An entry that is nearest to no row moves to one of the rows
    with the largest weighted error. All rounds but the last use a sample of _SAMPLE_ROWS_PER_ENTRY rows per entry on
    average. The result is deterministic.

    Args:
        rows: (N, D) float32, N at least 1.
        weights: (N,) weights of the rows, greater than 0.
        size: maximum number of entries.
        rounds: number of k-means rounds, at least 1.

    Returns:
        (K, D) float32 entries, K = min(size, N).
    """
    rng = np.random.default_rng(0)
    size = min(size, len(rows))
    # The rows of the smallest such numbers are a weighted sample without replacement.
    shuffled = np.argsort(rng.exponential(size=len(rows)) / weights, kind="stable")
    sample = np.sort(rng.permutation(len(rows))[: _SAMPLE_ROWS_PER_ENTRY * size])
    entries = rows[np.sort(shuffled[:size])]
    for _ in range(rounds - 1):
        entries = _run_lloyd_step(rows[sample], weights[sample], entries)
    return _run_lloyd_step(rows, weights, entries)


def find_nearest_entries(rows: np.ndarray, entries: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find the nearest entry of each row.

    Args:
        rows: (N, D) float32.
        entries: (K, D) float32.

    Returns:
        labels: (N,) int64 indices of the nearest entries.
        distances: (N,) float32 squared distances to them.
    """
    points, table = torch.from_numpy(rows), torch.from_numpy(entries).T.contiguous()
    half_squares = table.square().sum(0) / 2
    labels, distances = np.zeros(len(rows), np.int64), np.empty(len(rows), np.float32)

    def search(block: int) -> None:
        # |p - c|^2 is smallest where p . c - |c|^2 / 2 is largest.
        block_rows = slice(block * _BLOCK_ROWS, (block + 1) * _BLOCK_ROWS)
        best, block_labels = np.full(len(rows[block_rows]), -np.inf, np.float32), labels[block_rows]
        for first in range(0, len(entries), _BLOCK_ENTRIES):
            part = slice(first, first + _BLOCK_ENTRIES)
            scores = torch.addmm(half_squares[part], points[block_rows], table[:, part], beta=-1).numpy()
            nearest = scores.argmax(1)
            score = np.take_along_axis(scores, nearest[:, None], 1)[:, 0]
            better = score > best
            best[better], block_labels[better] = score[better], nearest[better] + first
        distances[block_rows] = np.maximum((rows[block_rows] ** 2).sum(1) - 2 * best, 0)

    run_tasks(search, -(-len(rows) // _BLOCK_ROWS))
    return labels, distances


def _run_lloyd_step(rows: np.ndarray, weights: np.ndarray, entries: np.ndarray) -> np.ndarray:
    """Run one k-means round: move each entry to the weighted mean of the rows that are nearest to it."""
    labels, distances = find_nearest_entries(rows, entries)
    mass = np.bincount(labels, weights, len(entries))
    sums = [np.bincount(labels, weights * column, len(entries)) for column in rows.T]
    moved = (np.stack(sums, 1) / np.where(mass > 0, mass, 1)[:, None]).astype(np.float32)
    idle = np.flatnonzero(mass == 0)
    moved[idle] = rows[np.argsort(-distances * weights, kind="stable")[: len(idle)]]
    return moved

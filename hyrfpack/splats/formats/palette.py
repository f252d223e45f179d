"""A palette for rows of numbers: k-means quick enough, on a CPU, for a million rows and thousands of entries."""

from __future__ import annotations

import numpy as np
import torch

from hyrfpack.parallel.pool import run_tasks

_ROWS, _ENTRIES = 1024, 512  # whose products are held at once by a thread: 2 MB, for the caches
_SAMPLE = 16  # rows for an entry, on average, that all rounds but the last look at


def build_palette(rows: np.ndarray, weights: np.ndarray, size: int, rounds: int = 6) -> np.ndarray:
    """Entries for which the sum over rows of weight times squared distance to the nearest is small: Lloyd's k-means.

    Starts from rows drawn with odds proportional to their weights. An entry that no row is nearest to moves to a row
    that is served worst. Large inputs are sampled in all rounds but the last. Deterministic.

    Args:
        rows: (N, D) float32, N at least 1.
        weights: (N,) of rows, more than 0.
        size: most entries.
        rounds: of k-means.

    Returns:
        (K, D) float32, K = min(size, N).
    """
    rng = np.random.default_rng(0)
    size = min(size, len(rows))
    shuffled = np.argsort(rng.exponential(size=len(rows)) / weights, kind="stable")  # a weighted draw without return
    sample = np.sort(rng.permutation(len(rows))[: _SAMPLE * size])
    entries = rows[np.sort(shuffled[:size])]
    for number in range(rounds):
        last = number == rounds - 1
        entries = _lloyd(rows, weights, entries) if last else _lloyd(rows[sample], weights[sample], entries)
    return entries


def nearest(rows: np.ndarray, entries: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The nearest entry of each row.

    Args:
        rows: (N, D) float32.
        entries: (K, D) float32.

    Returns:
        (N,) int64 its number, and (N,) float32 the squared distance.
    """
    points, table = torch.from_numpy(rows), torch.from_numpy(entries).T.contiguous()
    half_squares = table.square().sum(0) / 2
    labels, distances = np.empty(len(rows), np.int64), np.empty(len(rows), np.float32)

    def search(block: int) -> None:
        # |p - c|^2 is smallest where p . c - |c|^2 / 2 is largest.
        own = slice(block * _ROWS, (block + 1) * _ROWS)
        best, found = np.full(len(rows[own]), -np.inf, np.float32), labels[own]
        for first in range(0, len(entries), _ENTRIES):
            part = slice(first, first + _ENTRIES)
            scores = torch.addmm(half_squares[part], points[own], table[:, part], beta=-1).numpy()
            here = scores.argmax(1)
            score = np.take_along_axis(scores, here[:, None], 1)[:, 0]
            better = score > best
            best[better], found[better] = score[better], here[better] + first
        distances[own] = np.maximum((rows[own] ** 2).sum(1) - 2 * best, 0)

    run_tasks(search, -(-len(rows) // _ROWS))
    return labels, distances


def _lloyd(rows: np.ndarray, weights: np.ndarray, entries: np.ndarray) -> np.ndarray:
    """One round: each entry becomes the weighted mean of the rows that are nearest to it."""
    labels, distances = nearest(rows, entries)
    mass = np.bincount(labels, weights, len(entries))
    sums = [np.bincount(labels, weights * column, len(entries)) for column in rows.T]
    moved = (np.stack(sums, 1) / np.where(mass > 0, mass, 1)[:, None]).astype(np.float32)
    idle = np.flatnonzero(mass == 0)
    moved[idle] = rows[np.argsort(-distances * weights, kind="stable")[: len(idle)]]
    return moved

"""Divide points into compact groups of equal or bounded size."""

from __future__ import annotations

import numpy as np


def partition(points: np.ndarray, max_count: int) -> list[np.ndarray]:
    """Divide points (N, D) into groups of at most `max_count` points, by halving at the median of the longest axis.

    Returns:
        Ascending indices (n,) int64 of each group. All groups have almost equal sizes.
    """
    groups, waiting = [], [np.arange(len(points))]
    while waiting:
        members = waiting.pop()
        if len(members) <= max_count:
            groups.append(np.sort(members))
            continue
        left, right = _halve(points, members, len(members) // 2)
        waiting += [right, left]
    return groups


def cluster(features: np.ndarray, count: int) -> np.ndarray:
    """Divide points (N, D) into `count` clusters of similar points, of N / count points each up to rounding.

    Returns:
        (N,) int64 cluster of each point, 0 to count - 1; no cluster is empty if count is at most N.
    """
    labels, first = np.empty(len(features), np.int64), 0
    waiting = [(np.arange(len(features)), count)]
    while waiting:
        members, parts = waiting.pop()
        if parts == 1:
            labels[members] = first
            first += 1
            continue
        left_parts = parts // 2
        left, right = _halve(features, members, round(len(members) * left_parts / parts))
        waiting += [(right, parts - left_parts), (left, left_parts)]
    return labels


def _halve(points: np.ndarray, members: np.ndarray, left_count: int) -> tuple[np.ndarray, np.ndarray]:
    """Divide points along the axis of their largest extent; the first group has `left_count` of them."""
    values = points[members]
    axis = int(np.argmax(values.max(axis=0) - values.min(axis=0)))
    order = np.argsort(values[:, axis], kind="stable")
    return members[order[:left_count]], members[order[left_count:]]

"""The choice of photo pairs for matching."""

from __future__ import annotations

import numpy as np

from hyrfpack.poses.pairs import (
    choose_matching,
    compute_similarities,
    exhaustive_pairs,
    retrieval_pairs,
    sequential_pairs,
)


def make_descriptors(groups: list[int], seed: int = 0) -> list[np.ndarray]:
    """Return descriptors of photos, where photos of one group show the same things."""
    rng = np.random.default_rng(seed)
    things = rng.integers(0, 180, (max(groups) + 1, 60, 128))
    return [np.clip(things[group] + rng.integers(-8, 8, (60, 128)), 0, 255).astype(np.uint8) for group in groups]


def test_the_matching_method_follows_from_the_set():
    assert [choose_matching(count, False) for count in (3, 60, 61)] == ["exhaustive", "exhaustive", "retrieval"]
    assert choose_matching(60, True) == "sequential"


def test_exhaustive_matching_has_every_pair_once():
    pairs = exhaustive_pairs(7)
    assert len(set(pairs)) == len(pairs) == 21
    assert all(first < second for first, second in pairs)


def test_photos_of_the_same_things_are_similar():
    groups = [0, 1, 2, 0, 1, 2, 0, 1, 2]
    similar = compute_similarities(make_descriptors(groups), seed=0)
    same = np.equal.outer(groups, groups)
    assert similar[same].min() > similar[~same].max()
    assert np.array_equal(similar, compute_similarities(make_descriptors(groups), seed=0))


def test_photos_without_features_are_similar_to_none():
    similar = compute_similarities([*make_descriptors([0, 0]), np.zeros((0, 128), np.uint8)], seed=0)
    assert np.isfinite(similar).all() and not similar[2].any()


def test_sequential_matching_closes_loops():
    count = 60
    similar = np.zeros((count, count))
    similar[2, 57] = similar[57, 2] = 1.0
    similar[20, 31] = similar[31, 20] = 1.0
    similar[:40, 40:] = similar[40:, :40] = -np.inf  # only finite similarities count
    similar[2, 57] = similar[57, 2] = 0.5
    pairs = sequential_pairs(count, similar)
    assert {(0, 1), (0, 10), (0, 16), (2, 57), (20, 31)} <= set(pairs)
    near = np.where(np.abs(np.subtract.outer(range(count), range(count))) <= 10, 1.0, -np.inf)
    assert {second - first for first, second in sequential_pairs(count, near)} == {*range(1, 11), 16, 32}
    assert all(first < second for first, second in pairs) and len(set(pairs)) == len(pairs)


def test_retrieval_matches_similar_photos_and_neighbours():
    count = 300
    rng = np.random.default_rng(0)
    similar = rng.uniform(0, 0.1, (count, count))
    similar[5, 290] = 0.9
    pairs = set(retrieval_pairs(count, similar))
    assert (5, 290) in pairs and (5, 6) in pairs
    assert len(pairs) < count * 46


def test_retrieval_matches_a_third_of_the_pairs_of_a_hundred_photos():
    similar = np.random.default_rng(0).uniform(0, 0.1, (100, 100))
    pairs = retrieval_pairs(100, similar + similar.T)
    assert len(pairs) < 100 * 25
    partners = np.bincount(np.array(pairs).ravel(), minlength=100)
    assert partners.min() >= 20

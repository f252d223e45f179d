"""The count of matches that poses explain, tested with projections of known points."""

from __future__ import annotations

import numpy as np
from made_up_poses import circle_poses, transform_poses

from hyrfpack.poses.explained_matches import RayMatches, count_explained_matches, explained_mask


def match_neighbours(poses: dict[str, np.ndarray], noise: float = 0.0) -> list[RayMatches]:
    """Return matches of points around the origin between neighbouring cameras, for a pixel size of 0.001."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.5, 0.5, (40, 3))
    names = sorted(poses)
    rays = {}
    for name, pose in poses.items():
        seen = points @ pose[:, :3].T + pose[:, 3]
        rays[name] = seen[:, :2] / seen[:, 2:] + rng.normal(0, noise, (40, 2))
    near = [(a, b) for i, a in enumerate(names) for b in names[i + 1 : i + 4]]
    return [RayMatches(a, b, rays[a], rays[b], 0.001) for a, b in near]


def test_correct_poses_explain_all_matches_in_any_frame():
    poses = circle_poses()
    pairs = match_neighbours(poses, noise=0.0003)
    total = sum(len(pair.rays1) for pair in pairs)
    assert (
        count_explained_matches(poses, pairs) == count_explained_matches(transform_poses(poses), pairs) >= 0.999 * total
    )


def test_folded_poses_and_missing_photos_explain_fewer_matches():
    poses = circle_poses()
    pairs = match_neighbours(poses)
    names = sorted(poses)
    folded = {**poses, **{name: poses[onto] for name, onto in zip(names[16:], names[:8], strict=True)}}
    some = {name: poses[name] for name in names[:16]}
    assert count_explained_matches(folded, pairs) < count_explained_matches(poses, pairs)
    assert count_explained_matches(some, pairs) < count_explained_matches(poses, pairs)


def test_a_match_behind_a_camera_or_off_its_line_is_not_explained():
    poses = circle_poses(8)
    pair = match_neighbours(poses)[0]
    assert explained_mask(poses, pair).all()
    off = RayMatches(pair.first, pair.second, pair.rays1, pair.rays2 + np.array([0.0, 0.01]), pair.pixel)
    assert not explained_mask(poses, off).any()
    backwards = {
        name: np.column_stack([np.diag([-1.0, 1.0, -1.0]) @ pose[:, :3], np.diag([-1.0, 1.0, -1.0]) @ pose[:, 3]])
        for name, pose in poses.items()
    }
    behind = RayMatches(pair.first, pair.second, pair.rays1 * [-1, -1], pair.rays2 * [-1, -1], pair.pixel)
    assert not explained_mask(
        backwards, RayMatches(pair.first, pair.second, -behind.rays1, -behind.rays2, pair.pixel)
    ).all()

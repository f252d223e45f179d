"""Comparison of two reconstructions: known similarities, folds, mirrored scenes and pieces."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from made_up_poses import circle_poses, line_poses, transform_poses
from scipy.spatial.transform import Rotation

from hyrfpack.poses.alignment import _sample_camera_pairs, align_poses, camera_extent, camera_positions


@pytest.mark.parametrize("count", [2, 3, 50, 90, 91, 700, 20_000])
def test_compared_pairs_are_all_or_a_sample_without_repetitions(count):
    tracemalloc.start()
    pairs = _sample_camera_pairs(count)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    everything = count * (count - 1) // 2
    assert len(pairs) == min(everything, 4000) == len(set(map(tuple, pairs.tolist())))
    assert (pairs[:, 0] < pairs[:, 1]).all() and pairs.min() >= 0 and pairs.max() < count
    assert peak < 5_000_000  # bytes


@pytest.mark.parametrize("poses", [circle_poses(), line_poses()])
def test_all_cameras_agree_after_a_change_of_frame(poses):
    found = align_poses(poses, transform_poses(poses))
    assert found.agreeing == set(poses)
    assert found.distance.max() < 1e-9
    assert found.scale == pytest.approx(2.5)


def test_small_errors_agree_and_large_ones_do_not():
    exact = circle_poses()
    rough = transform_poses(circle_poses(noise=0.02))
    assert align_poses(rough, exact).agreeing == set(exact)
    assert len(align_poses(transform_poses(circle_poses(noise=1.0, seed=2)), exact).agreeing) < 12


def test_cameras_folded_onto_others_do_not_agree():
    exact = circle_poses()
    folded = dict(exact)
    names = sorted(exact)
    for name, onto in zip(names[16:], names[:8], strict=True):  # as when one wall is mistaken for another
        folded[name] = exact[onto]
    assert align_poses(transform_poses(folded), exact).agreeing == set(names[:16])
    assert align_poses(exact, transform_poses(folded)).agreeing == set(names[:16])


def test_cameras_with_right_positions_and_wrong_rotations_do_not_agree():
    exact = circle_poses()
    turned = dict(exact)
    for name in sorted(exact)[:5]:
        about = Rotation.from_euler("y", 30, degrees=True).as_matrix() @ exact[name][:, :3]
        turned[name] = np.column_stack([about, -about @ camera_positions({name: exact[name]})[0]])
    assert align_poses(turned, exact).agreeing == set(sorted(exact)[5:])


def test_a_mirrored_scene_does_not_agree():
    exact = circle_poses()
    mirror = np.diag([1.0, 1.0, -1.0])
    flipped = {}
    for name, pose in exact.items():
        rotation = mirror @ pose[:, :3] @ mirror  # depth reversed, as under weak perspective
        flipped[name] = np.column_stack([rotation, mirror @ pose[:, 3] + np.array([0, 0, 6.0])])
    assert len(align_poses(flipped, exact).agreeing) < len(exact) / 2


def test_only_common_photos_are_compared_and_two_are_too_few():
    exact = circle_poses()
    half = {name: pose for name, pose in exact.items() if name < "012"}
    assert align_poses(half, exact).agreeing == set(half)
    two = dict(list(exact.items())[:2])
    assert align_poses(two, exact).agreeing == frozenset()
    assert align_poses({}, exact).agreeing == frozenset()
    one_place = {name: np.column_stack([np.eye(3), np.zeros(3)]) for name in exact}
    assert align_poses(one_place, exact).agreeing == frozenset()
    assert align_poses(exact, one_place).agreeing == frozenset()


def test_the_extent_is_the_diagonal_of_the_box_around_the_cameras():
    assert camera_extent(line_poses(12)) == pytest.approx(11)
    far = {**circle_poses(100), "astray.jpg": np.column_stack([np.eye(3), [1e6, 0, 0]])}
    assert camera_extent(far) < 12

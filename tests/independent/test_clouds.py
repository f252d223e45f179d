"""The comparison of clouds accepts equal clouds and detects every known kind of corruption."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from independent.clouds import (
    FLOAT32_PRECISION,
    HALF_TURN_ABOUT_X,
    cloud_from_ply,
    cloud_from_splats,
    compare_clouds,
    ply_from_splats,
    sample_splats,
    undo_rotation,
)
from independent.formats import LOOSEST_PRECISION

from hyrfpack.splats.splats import Splats


def test_order_and_quaternion_signs_make_no_difference():
    splats = sample_splats(3)
    quats = np.where(np.arange(len(splats))[:, None] % 2, -splats.quats, splats.quats)
    shuffled = replace(splats, quats=quats)[np.random.default_rng(0).permutation(len(splats))]
    assert compare_clouds(cloud_from_splats(splats), cloud_from_splats(shuffled)).is_within(FLOAT32_PRECISION)
    assert compare_clouds(cloud_from_splats(splats), cloud_from_ply(ply_from_splats(splats))).is_within(
        FLOAT32_PRECISION
    )


def test_undo_rotation_restores_a_rotated_cloud():
    splats = sample_splats(3)
    cloud = cloud_from_splats(splats)
    theirs = cloud_from_splats(splats.rotated(HALF_TURN_ABOUT_X))
    assert not compare_clouds(cloud, theirs).is_within(LOOSEST_PRECISION)
    assert compare_clouds(cloud, undo_rotation(theirs, HALF_TURN_ABOUT_X)).is_within(FLOAT32_PRECISION)


def _reorder(name: str, axis: int, order: list[int]) -> Callable[[Splats], Splats]:
    return lambda splats: replace(splats, **{name: np.take(getattr(splats, name), order, axis=axis)})


def _multiply(name: str, factors: object) -> Callable[[Splats], Splats]:
    return lambda splats: replace(splats, **{name: getattr(splats, name) * np.asarray(factors)})


def _read_planar_as_interleaved(splats: Splats) -> Splats:
    higher = splats.harmonics[:, 1:]
    mixed = higher.transpose(0, 2, 1).reshape(higher.shape)
    return replace(splats, harmonics=np.concatenate((splats.harmonics[:, :1], mixed), axis=1))


CONDON_SHORTLEY_SIGNS = np.array([1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1.0])[:, None]
CORRUPTIONS_BY_NAME = {
    "x mirrored": _multiply("positions", [-1, 1, 1]),
    "y and z exchanged": _reorder("positions", 1, [0, 2, 1]),
    "turned about x, colours too": lambda splats: splats.rotated(HALF_TURN_ABOUT_X),
    "quaternions inverted": _multiply("quats", [1, -1, -1, -1]),
    "quaternions as xyzw": _reorder("quats", 1, [1, 2, 3, 0]),
    "quaternions turned about x only": _multiply("quats", [1, 1, -1, -1]),
    "scales of other axes": _reorder("scales", 1, [1, 2, 0]),
    "variances for deviations": lambda splats: replace(splats, scales=splats.scales**2),
    "opacities reversed": lambda splats: replace(splats, opacities=1 - splats.opacities),
    "opacities of others": lambda splats: replace(splats, opacities=np.roll(splats.opacities, 1)),
    "red and blue exchanged": _reorder("harmonics", 2, [2, 1, 0]),
    "red and green of the higher bands exchanged": lambda splats: replace(
        splats, harmonics=np.concatenate((splats.harmonics[:, :1], splats.harmonics[:, 1:, [1, 0, 2]]), axis=1)
    ),
    "harmonics planar for interleaved": _read_planar_as_interleaved,
    "harmonics without Condon-Shortley phase": _multiply("harmonics", CONDON_SHORTLEY_SIGNS),
    "harmonics of band 1 as x, y, z": _reorder("harmonics", 1, [0, 3, 1, 2, *range(4, 16)]),
    "harmonics of band 3 reversed": _reorder("harmonics", 1, [*range(9), *range(15, 8, -1)]),
    "colours for harmonics": lambda splats: replace(
        splats, harmonics=np.concatenate((splats.harmonics[:, :1] * 0.28 + 0.5, splats.harmonics[:, 1:]), axis=1)
    ),
}


@pytest.mark.parametrize("corruption", CORRUPTIONS_BY_NAME)
def test_the_loosest_precision_detects(corruption):
    splats = sample_splats(3)
    wrong = CORRUPTIONS_BY_NAME[corruption](splats)
    assert not compare_clouds(cloud_from_splats(splats), cloud_from_splats(wrong)).is_within(LOOSEST_PRECISION)


def test_different_counts_and_degrees_are_detected():
    splats = sample_splats(1)
    with pytest.raises(AssertionError, match="299 Gaussians instead of 300"):
        compare_clouds(cloud_from_splats(splats), cloud_from_splats(splats[1:]))
    with pytest.raises(AssertionError, match="degree 0 instead of 1"):
        compare_clouds(cloud_from_splats(splats), cloud_from_splats(splats.with_degree(0)))

"""The comparison itself: what it lets through and what it catches, so that the other tests here mean something."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from independent.clouds import (
    EXACT,
    TURN_ABOUT_X,
    cloud_of_ours,
    cloud_of_ply,
    differences,
    made_up,
    ply_of,
    turned_back,
)
from independent.formats import LOOSEST

from hyrfpack.splats.splats import Splats


def test_the_same_cloud_in_another_order_with_other_quaternions_is_no_different():
    splats = made_up(3)
    quats = np.where(np.arange(len(splats))[:, None] % 2, -splats.quats, splats.quats)
    shuffled = replace(splats, quats=quats)[np.random.default_rng(0).permutation(len(splats))]
    assert differences(cloud_of_ours(splats), cloud_of_ours(shuffled)).within(EXACT)
    assert differences(cloud_of_ours(splats), cloud_of_ply(ply_of(splats))).within(EXACT)


def test_a_turned_cloud_turned_back_is_no_different():
    splats = made_up(3)
    cloud = cloud_of_ours(splats)
    theirs = cloud_of_ours(splats.rotated(TURN_ABOUT_X))
    assert not differences(cloud, theirs).within(LOOSEST)
    assert differences(cloud, turned_back(theirs, TURN_ABOUT_X)).within(EXACT)


def _swap(name: str, axis: int, order: list[int]) -> Callable[[Splats], Splats]:
    return lambda splats: replace(splats, **{name: np.take(getattr(splats, name), order, axis=axis)})


def _times(name: str, factors: object) -> Callable[[Splats], Splats]:
    return lambda splats: replace(splats, **{name: getattr(splats, name) * np.asarray(factors)})


def _planar_as_interleaved(splats: Splats) -> Splats:
    higher = splats.harmonics[:, 1:]
    mixed = higher.transpose(0, 2, 1).reshape(higher.shape)
    return replace(splats, harmonics=np.concatenate((splats.harmonics[:, :1], mixed), axis=1))


TERM_SIGNS = np.array([1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1.0])[:, None]
MISTAKES = {
    "x mirrored": _times("positions", [-1, 1, 1]),
    "y and z exchanged": _swap("positions", 1, [0, 2, 1]),
    "turned about x, colours too": lambda splats: splats.rotated(TURN_ABOUT_X),
    "quaternions inverted": _times("quats", [1, -1, -1, -1]),
    "quaternions as xyzw": _swap("quats", 1, [1, 2, 3, 0]),
    "quaternions turned about x only": _times("quats", [1, 1, -1, -1]),
    "scales of other axes": _swap("scales", 1, [1, 2, 0]),
    "variances for deviations": lambda splats: replace(splats, scales=splats.scales**2),
    "opacities reversed": lambda splats: replace(splats, opacities=1 - splats.opacities),
    "opacities of others": lambda splats: replace(splats, opacities=np.roll(splats.opacities, 1)),
    "red and blue exchanged": _swap("harmonics", 2, [2, 1, 0]),
    "red and green of the higher bands exchanged": lambda splats: replace(
        splats, harmonics=np.concatenate((splats.harmonics[:, :1], splats.harmonics[:, 1:, [1, 0, 2]]), axis=1)
    ),
    "harmonics planar for interleaved": _planar_as_interleaved,
    "harmonics without Condon-Shortley phase": _times("harmonics", TERM_SIGNS),
    "harmonics of band 1 as x, y, z": _swap("harmonics", 1, [0, 3, 1, 2, *range(4, 16)]),
    "harmonics of band 3 reversed": _swap("harmonics", 1, [*range(9), *range(15, 8, -1)]),
    "colours for harmonics": lambda splats: replace(
        splats, harmonics=np.concatenate((splats.harmonics[:, :1] * 0.28 + 0.5, splats.harmonics[:, 1:]), axis=1)
    ),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_the_loosest_tolerance_catches(mistake):
    splats = made_up(3)
    wrong = MISTAKES[mistake](splats)
    assert not differences(cloud_of_ours(splats), cloud_of_ours(wrong)).within(LOOSEST)


def test_another_number_of_gaussians_is_caught():
    splats = made_up(1)
    with pytest.raises(AssertionError, match="299 Gaussians instead of 300"):
        differences(cloud_of_ours(splats), cloud_of_ours(splats[1:]))
    with pytest.raises(AssertionError, match="degree 0 instead of 1"):
        differences(cloud_of_ours(splats), cloud_of_ours(splats.with_degree(0)))

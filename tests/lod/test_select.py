"""The choice of levels of detail, against an exhaustive search and closed forms."""

from __future__ import annotations

import math
from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scenes import camera_at

from hyrfpack.format.scene_manifest import Chunk, ChunkLevel, Manifest, ScenePart
from hyrfpack.lod.select import choose_levels, predict_errors, project_sphere, select_levels

pytestmark = pytest.mark.unit

ITEM = st.lists(st.tuples(st.integers(1, 40), st.integers(0, 100)), min_size=1, max_size=4)


def total(values, levels):
    return sum(each[level] for each, level in zip(values, levels, strict=True))


@given(st.lists(ITEM, min_size=1, max_size=5), st.integers(0, 200))
def test_the_greedy_choice_is_within_its_bound_of_the_best_one(items, limit):
    costs = [[cost for cost, _ in item] for item in items]
    errors = [[float(error) for _, error in item] for item in items]
    choices = list(product(*(range(len(item)) for item in items)))
    fitting = [total(errors, levels) for levels in choices if total(costs, levels) <= limit]

    levels, max_gap = choose_levels(costs, errors, limit)

    if not fitting:
        assert total(costs, levels) == min(total(costs, levels) for levels in choices)
        return
    assert total(costs, levels) <= limit
    assert total(errors, levels) - min(fitting) <= max_gap + 1e-9


def test_without_a_limit_the_least_error_is_chosen():
    assert choose_levels([[9, 5, 2], [4, 3]], [[0, 1, 2], [0.5, 0]], math.inf) == ([0, 1], 0.0)


def make_manifest(*centers) -> Manifest:
    levels = (
        ChunkLevel("{}-0.hyrf", 900, "0" * 8, 100, (0.0, 0.0)),
        ChunkLevel("{}-1.hyrf", 300, "0" * 8, 25, (0.001, 0.009)),
    )
    chunks = tuple(Chunk(tuple(np.add(c, -0.5)), tuple(np.add(c, 0.5)), levels) for c in centers)
    shared = ScenePart("shared.hyrf", 50, "0" * 8)
    return Manifest(100 * len(chunks), (shared,), chunks, (10.0, 1000.0), {}, False, (0.0, 0.0, 0.0))


def test_a_nearer_chunk_is_refined_first_and_one_behind_the_camera_never():
    camera = camera_at((0, -10, 0), width=100, height=100, focal=100)
    manifest = make_manifest((0, 20, 0), (0, -4, 0), (0, -20, 0))

    choice = select_levels(manifest, camera, gaussians=150)

    assert choice.levels == [1, 0, 1]
    assert (choice.gaussians, choice.bytes) == (150, 50 + 300 + 900 + 300)
    assert select_levels(manifest, camera).levels == [0, 0, 1]
    assert select_levels(manifest, camera, bytes=50 + 3 * 300 + 599).levels == [1, 0, None]


def test_what_a_view_shows_least_is_left_out_where_not_even_coarsest_levels_fit():
    camera = camera_at((0, -10, 0), width=100, height=100, focal=100)
    manifest = make_manifest((0, 20, 0), (0, -4, 0), (0, -20, 0))

    assert select_levels(manifest, camera, gaussians=50).levels == [1, 1, None]
    assert select_levels(manifest, camera, gaussians=49).levels == [None, 1, None]
    assert select_levels(manifest, camera, gaussians=75).levels == [1, 1, 1]
    nothing = select_levels(manifest, camera, bytes=0)
    assert (nothing.levels, nothing.gaussians, nothing.bytes) == ([None] * 3, 0, 50)
    assert nothing.predicted_mse > select_levels(manifest, camera, gaussians=49).predicted_mse > 0


def test_a_sphere_projects_as_seen_by_a_pinhole_camera():
    camera = camera_at((0, -8, 0), width=200, height=200, focal=100)

    radius, area = project_sphere((0, 0, 0), 0.8, camera)

    assert radius == pytest.approx(100 * 0.8 / 8)
    assert area == pytest.approx(math.pi * 10**2)
    assert project_sphere((0, -9, 0), 0.5, camera)[1] == 0
    assert project_sphere((0, -8, 0), 0.5, camera) == pytest.approx((100, 200 * 200))


def test_errors_are_interpolated_in_the_logarithm_of_the_radius():
    camera = camera_at((0, -math.sqrt(3) / 2, 0), width=200, height=200, focal=100)
    manifest = make_manifest((0, 0, 0))

    # The radius 100 is half-way between 10 and 1000, and all is in view.
    ((finest, coarse, left_out),) = predict_errors(manifest, camera)

    assert finest == 0
    assert coarse == pytest.approx(0.005)
    assert left_out == pytest.approx(3 * coarse)


def test_two_limits_exclude_each_other():
    with pytest.raises(ValueError, match="give one of them"):
        select_levels(make_manifest((0, 0, 0)), camera_at((0, -3, 0)), gaussians=5, bytes=5)

"""Measured errors of levels predict those of the views that they were measured in."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scenes import ball_points, camera_at, ring, small_model

from hyrfpack.format.scene_manifest import Chunk, ChunkLevel, Manifest, ScenePart
from hyrfpack.format.scene_model import join_chunks
from hyrfpack.lod import errors
from hyrfpack.lod.errors import ERROR_RADII, measure_level_errors
from hyrfpack.lod.select import MIN_LEFT_OUT_MSE, predict_errors, project_sphere, select_levels
from hyrfpack.render import render_view

pytestmark = pytest.mark.unit

LOW, HIGH = (-1.2, -1.2, -1.2), (1.2, 1.2, 1.2)


def make_levels():
    """Return two chunks, the halves of a ball, at two levels: all Gaussians, and every second one."""
    points, colors = ball_points(300)
    logits = np.log(np.clip(colors, 0.02, 0.98) / (1 - np.clip(colors, 0.02, 0.98)))
    model = small_model(points, color_logits=logits.astype(np.float32)).requires_grad_(False)
    halves = [np.flatnonzero(side) for side in (points[:, 0] < 0, points[:, 0] >= 0)]
    return [[model.subset(torch.from_numpy(half[::step])) for half in halves] for step in (1, 2)]


def manifest_of(measured: np.ndarray, boxes=((LOW, HIGH), (LOW, HIGH))) -> Manifest:
    def level(number: int, chunk: int) -> ChunkLevel:
        return ChunkLevel(f"{chunk}-{number}.hyrf", 1, "0" * 8, 1, tuple(measured[number, chunk]))

    chunks = tuple(Chunk(*boxes[chunk], (level(0, chunk), level(1, chunk))) for chunk in range(2))
    return Manifest(2, (ScenePart("s.hyrf", 1, "0" * 8),), chunks, ERROR_RADII, {}, False, (0.0, 0.0, 0.0))


def test_predictions_add_up_to_the_error_of_the_measured_views(monkeypatch):
    monkeypatch.setattr(errors, "RESOLUTION_RATIOS", ((1.0,),))
    levels, cameras = make_levels(), ring(3, radius=4.0, width=48, height=48)
    fine, coarse = (join_chunks(level[0], level) for level in levels)
    actual = [float((render_view(fine, c).rgb - render_view(coarse, c).rgb).square().mean()) for c in cameras]
    sphere = (Chunk(LOW, HIGH, ()).center, Chunk(LOW, HIGH, ()).radius)

    measured = measure_level_errors(levels, [sphere, sphere], cameras)

    predicted = [sum(chunk[1] for chunk in predict_errors(manifest_of(measured), camera)) for camera in cameras]
    assert (measured[0] == 0).all() and (measured[1] > 0).all()
    assert np.mean(predicted) == pytest.approx(np.mean(actual), rel=0.25)


def test_chunks_of_two_parts_have_the_errors_of_chunks_of_one(monkeypatch):
    """So each part is seen among the Gaussians of the other one."""
    monkeypatch.setattr(errors, "RESOLUTION_RATIOS", ((1.0,),))
    levels, cameras = make_levels(), ring(2, radius=4.0, width=48, height=48)
    spheres = [(Chunk(LOW, HIGH, ()).center, Chunk(LOW, HIGH, ()).radius)] * 2

    together = measure_level_errors(levels, spheres, cameras)
    parts = measure_level_errors(levels, spheres, cameras, fields=[levels[0][0]] * 2, parts=[0, 1])

    np.testing.assert_allclose(parts, together, rtol=1e-3)


@pytest.mark.parametrize("parts", [1, 2])
@torch.no_grad()
def test_errors_are_divided_among_chunks_by_their_light(parts: int, monkeypatch):
    """As if each chunk were drawn by itself, in white among the others in black."""
    monkeypatch.setattr(errors, "RESOLUTION_RATIOS", ((1.0,),))
    (camera,) = ring(1, radius=4.0, width=48, height=48)
    levels, sphere = make_levels(), (Chunk(LOW, HIGH, ()).center, Chunk(LOW, HIGH, ()).radius)
    fields, numbers = ([levels[0][0]], [0, 0]) if parts == 1 else ([levels[0][0]] * 2, [0, 1])

    measured = measure_level_errors(levels, [sphere] * 2, [camera], fields=fields, parts=numbers)

    pool = errors._PooledChunks.of(levels, fields, numbers)
    view, finest = pool.open_view(camera), pool.draw(np.zeros(2, np.int64), camera)
    only_first, only_second = np.array([True, False]), np.array([False, True])
    light = view.draw_shares((only_first, only_second)).double().numpy()
    in_half = np.random.default_rng(0).permutation(2) % 2 == 0
    assert in_half.sum() == 1  # so each chunk is a half
    radius, area = project_sphere(*sphere, camera)
    for chunk, own in enumerate((only_first, only_second)):
        error = (pool.draw(own * 1, camera) - finest).square().mean(dim=-1).double().numpy()
        share = light[..., chunk]
        expected = (error * share / (share + errors.LIGHT_SHARE_OFFSET)).sum() / area
        node = int(np.abs(np.log(np.array(ERROR_RADII) / radius)).argmin())
        assert measured[1, chunk, node] == pytest.approx(expected, rel=1e-5)


def make_distant_levels(offset: float):
    """Return `make_levels` with the second chunk moved along x, and the sphere of each chunk."""
    levels = make_levels()
    for level in levels:
        level[1].gaussians.positions.data[:, 0] += offset
    centers = [(-0.6, 0.0, 0.0), (0.6 + offset, 0.0, 0.0)]
    return levels, [(center, 1.3) for center in centers]


def test_a_chunk_that_no_view_shows_has_the_errors_of_the_others():
    levels, spheres = make_distant_levels(50.0)
    camera = camera_at((-0.6, -4.0, 0.0), (-0.6, 0.0, 0.0), width=48, height=48)

    measured = measure_level_errors(levels, spheres, [camera])

    assert (measured[1, 0] > 0).all() and (measured[0] == 0).all()
    np.testing.assert_allclose(measured[1, 1], measured[1, 0])
    toward = camera_at((50.6, -4.0, 0.0), (50.6, 0.0, 0.0), width=48, height=48)
    boxes = [(np.subtract(center, 0.75), np.add(center, 0.75)) for center, _ in spheres]
    assert select_levels(manifest_of(measured, boxes), toward).levels[1] == 0


def test_a_chunk_behind_the_camera_is_not_measured_where_its_sphere_holds_the_camera():
    levels, spheres = make_distant_levels(-3.2)
    camera = camera_at((-1.6, 0.0, 0.0), (-0.6, 0.0, 0.0), width=48, height=48)
    assert project_sphere(*spheres[1], camera)[1] > 0

    measured = measure_level_errors(levels, spheres, [camera])

    assert (measured[1, 0] > 0).all()
    np.testing.assert_allclose(measured[1, 1], measured[1, 0])


def test_without_a_measured_chunk_coarse_levels_have_the_least_error_of_a_chunk_that_is_left_out():
    levels, spheres = make_distant_levels(50.0)
    away = camera_at((0.0, -10.0, 0.0), (0.0, -20.0, 0.0), width=48, height=48)

    for cameras in ([], [away]):
        measured = measure_level_errors(levels, spheres, cameras)
        assert (measured[0] == 0).all() and (measured[1] == MIN_LEFT_OUT_MSE).all()


def test_estimated_errors_weigh_chunks_by_their_areas_and_never_fall_towards_coarser_levels():
    areas = np.zeros((3, len(ERROR_RADII)))
    areas[0, 2], areas[1, 2], areas[1, 4] = 1.0, 3.0, 2.0
    sums = np.zeros((3, *areas.shape))
    sums[1, 0, 2], sums[1, 1, 2], sums[1, 1, 4] = 0.4, 0.4, 0.2
    sums[2, 0, 2], sums[2, 1, 2], sums[2, 1, 4] = 0.2, 0.2, 0.8

    estimated = errors._fill_gaps(sums, areas)[:, 2]

    np.testing.assert_allclose(estimated[1], [0.2] * 4 + [0.1] * 3)
    np.testing.assert_allclose(estimated[2], [0.2] * 4 + [0.4] * 3)

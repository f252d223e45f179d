"""Measured errors of levels predict those of the views that they were measured in."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scenes import ball_points, ring, small_model

from hyrfpack.format.scene_manifest import Chunk, ChunkLevel, Manifest, ScenePart
from hyrfpack.format.scene_model import join_chunks
from hyrfpack.lod import errors
from hyrfpack.lod.errors import ERROR_RADII, measure_level_errors
from hyrfpack.lod.select import predict_errors
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


def manifest_of(measured: np.ndarray) -> Manifest:
    def level(number: int, chunk: int) -> ChunkLevel:
        return ChunkLevel(f"{chunk}-{number}.hyrf", 1, "0" * 8, 1, tuple(measured[number, chunk]))

    chunks = tuple(Chunk(LOW, HIGH, (level(0, chunk), level(1, chunk))) for chunk in range(2))
    return Manifest(2, (ScenePart("s.hyrf", 1, "0" * 8),), chunks, ERROR_RADII, {}, False, (0.0, 0.0, 0.0))


def test_predictions_add_up_to_the_error_of_the_measured_views(monkeypatch):
    monkeypatch.setattr(errors, "RESOLUTION_SHARES", ((1.0,),))
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
    monkeypatch.setattr(errors, "RESOLUTION_SHARES", ((1.0,),))
    levels, cameras = make_levels(), ring(2, radius=4.0, width=48, height=48)
    spheres = [(Chunk(LOW, HIGH, ()).center, Chunk(LOW, HIGH, ()).radius)] * 2

    together = measure_level_errors(levels, spheres, cameras)
    parts = measure_level_errors(levels, spheres, cameras, fields=[levels[0][0]] * 2, parts=[0, 1])

    np.testing.assert_allclose(parts, together, rtol=1e-3)

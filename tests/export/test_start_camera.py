"""A page starts at a camera that sees the scene, not at one that stands in haze."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import ring, small_model

from hyrfpack.cameras.capture import provenance_cameras
from hyrfpack.cameras.paths import Viewpoint
from hyrfpack.export.pages import choose_page_cameras, choose_start
from hyrfpack.export.source import Source
from hyrfpack.format import save_model

RING_CAMERAS = ring(8, width=96, height=64)


def read_source(tmp_path, positions: np.ndarray, scale_logits: float | np.ndarray = -4.0) -> Source:
    model = small_model(positions, scale_logits=scale_logits)
    kept = {"cameras": provenance_cameras(RING_CAMERAS), "viewpoint": Viewpoint.from_cameras(RING_CAMERAS).to_json()}
    save_model(model, tmp_path / "model.hyrf", provenance=kept)
    return Source.read(tmp_path / "model.hyrf")


def test_a_camera_inside_haze_is_not_the_first(tmp_path):
    scene = np.random.default_rng(0).uniform(-0.4, 0.4, (60, 3))
    haze = np.repeat(np.array([RING_CAMERAS[0].position + 0.3 * RING_CAMERAS[0].forward]), 6, axis=0)
    loaded = read_source(tmp_path, np.concatenate([scene, haze]), np.array([[-4.0]] * 60 + [[3.0]] * 6))
    first, *others = choose_page_cameras(loaded)
    assert not np.allclose(first.position, RING_CAMERAS[0].position, atol=1e-4)
    assert len(others) == 7, "a camera is lost"
    angles = [np.arctan2(camera.position[1], camera.position[0]) for camera in [first, *others]]
    steps = np.diff(np.unwrap(angles))
    assert np.allclose(steps, steps[0], atol=1e-3), "the order of the cameras is lost"


def test_the_first_photo_stays_first_where_all_see_the_scene(tmp_path):
    loaded = read_source(tmp_path, np.random.default_rng(0).uniform(-0.4, 0.4, (60, 3)))
    assert np.allclose(choose_page_cameras(loaded)[0].position, RING_CAMERAS[0].position, atol=1e-4)


@pytest.mark.unit
@pytest.mark.parametrize(
    ("details", "start"),
    [([1.0], 0), ([0.0, 0.0], 0), ([0.3, 0.6, 1.0, 1.0], 1), ([0.6, 2.0, 1.0], 0), ([0.1, 0.2, 3.0, 3.0, 3.0], 2)],
)
def test_the_start_is_the_first_picture_with_half_the_median_detail(details, start):
    assert choose_start(details) == start

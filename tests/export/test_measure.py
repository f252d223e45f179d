"""The loss of an export is measured between pictures of model and splats from the same cameras."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from exposures import map_with_gains
from scenes import camera_at, ring, small_model, view_of

from hyrfpack.export.background import render_background_picture
from hyrfpack.export.bake import bake
from hyrfpack.export.measure import _sample_panorama, measure_psnr
from hyrfpack.scene import Camera, Picture
from hyrfpack.splats.splats import Splats

GAUSSIAN_POSITIONS = np.random.default_rng(0).uniform(-0.6, 0.6, (40, 3))
RING_CAMERAS = ring(3)
INVISIBLE_SETTINGS = {"opacity_logits": -80.0}


def empty_splats() -> Splats:
    none = np.zeros((0, 3))
    return Splats(none, none, np.zeros((0, 4)), np.zeros(0), none[:, None])


def direction_panorama(height: int) -> np.ndarray:
    """Return (H, 2H, 3) with the colour (d + 1) / 2 of the direction d, as defined at `render_background_picture`."""
    a = 2 * np.pi * (np.arange(2 * height) + 0.5) / (2 * height) - np.pi
    b = (np.pi / 2 - np.pi * (np.arange(height) + 0.5) / height)[:, None]
    d = np.stack(np.broadcast_arrays(np.cos(b) * np.sin(a), -np.sin(b), np.cos(b) * np.cos(a)), -1)
    return ((d + 1) / 2).astype(np.float32)


def ray_directions(camera: Camera) -> np.ndarray:
    """Return (H, W, 3) unit directions in the world through the pixel centres."""
    columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    fx, fy, cx, cy = camera.intrinsics
    directions = np.stack([(columns - cx) / fx, (rows - cy) / fy, np.ones_like(columns)], -1) @ camera.rotation
    return directions / np.linalg.norm(directions, axis=-1, keepdims=True)


# -- panoramas -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("target", [(0, 0, 1), (1, 0, 0), (-1, 0.3, 0.2), (0, 0, -1), (0, -1, 0), (0, 1, 0), (1, 1, 1)])
def test_a_panorama_is_sampled_correctly_across_the_seam_and_at_the_poles(target):
    camera = camera_at((5.0, -3.0, 700.0), np.add((5.0, -3.0, 700.0), target), (0.1, 0.2, 1), width=31, height=24)
    seen = _sample_panorama(torch.from_numpy(direction_panorama(180)), camera).numpy()
    expected = (ray_directions(camera) + 1) / 2
    assert seen.shape == (24, 31, 3)
    # The tolerance is half a pixel at the poles, where no row follows the last one.
    assert np.abs(seen - expected).max() < 0.5 * math.radians(1) / 2 + 1e-4
    assert np.abs(seen - expected).mean() < 5e-4


def test_a_panorama_is_interpolated_across_the_seam():
    picture = np.zeros((4, 8, 3), np.float32)
    picture[:, 0], picture[:, -1] = 1.0, 0.5
    camera = camera_at((0, 0, 0), (0, 0, -1), (0, -1, 0), width=101, height=1, focal=1e4)
    seen = _sample_panorama(torch.from_numpy(picture), camera)
    assert torch.allclose(seen[0, 50], torch.full((3,), 0.75), atol=1e-5)  # the middle between the two columns
    assert float(seen.diff(dim=1).abs().max()) < 1e-3


def test_the_background_picture_approximates_the_background_of_the_model():
    model = small_model(GAUSSIAN_POSITIONS, fields=1.0, background=True, **INVISIBLE_SETTINGS)
    picture = render_background_picture(model, height=128)
    scores = measure_psnr(model, {"page": (empty_splats(), picture)}, [(c, None) for c in RING_CAMERAS], sphere=True)
    assert scores["page"].model > 40
    without = measure_psnr(model, {"page": (empty_splats(), None)}, [(c, None) for c in RING_CAMERAS], sphere=True)
    assert without["page"].model < 25


# -- scores ----------------------------------------------------------------------------------------------------------


def test_baked_splats_of_a_uniform_color_have_the_maximum_psnr():
    model = small_model(GAUSSIAN_POSITIONS, color_logits=0.7)  # a uniform colour is exact at degree 0
    scores = measure_psnr(model, {"0": (bake(model, [])[3], None)}, [(c, None) for c in RING_CAMERAS], sphere=False)
    assert scores["model"].model == 100 and scores["model"].photos is None
    assert scores["0"].model > 60 and scores["0"].photos is None


def test_scores_are_the_mean_psnr_over_views():
    model = small_model(GAUSSIAN_POSITIONS, solid=(1.0, 1.0, 1.0), **INVISIBLE_SETTINGS)
    photos = [np.full((32, 32, 3), level, np.uint8) for level in (204, 153)]
    views = [(c, view_of("photo", c, Picture(photo))) for c, photo in zip(RING_CAMERAS, photos, strict=False)]
    scores = measure_psnr(model, {"nothing": (empty_splats(), None)}, views, sphere=False)
    expected = (-20 * math.log10(0.2) - 20 * math.log10(0.4)) / 2
    assert scores["model"].photos == pytest.approx(expected, abs=1e-4)
    assert scores["nothing"].photos == pytest.approx(expected, abs=1e-4)
    assert scores["nothing"].model == 100


def test_transparent_photos_are_composited_on_the_solid_color():
    model = small_model(GAUSSIAN_POSITIONS, solid=(1.0, 1.0, 1.0), **INVISIBLE_SETTINGS)
    clear = Picture(np.zeros((32, 32, 3), np.uint8), np.zeros((32, 32), np.uint8))
    scores = measure_psnr(model, {}, [(RING_CAMERAS[0], view_of("photo", RING_CAMERAS[0], clear))], sphere=False)
    assert scores["model"].photos == 100


def test_a_solid_colour_behind_splats_is_exposed_as_in_renders_of_the_model():
    model = small_model(GAUSSIAN_POSITIONS, solid=(0.2, 0.4, 0.6), **INVISIBLE_SETTINGS)
    model.exposure = map_with_gains(RING_CAMERAS, model.config.frame, np.array([[0.5], [2.0], [3.0]]))
    candidates = {"local": (empty_splats(), None), "consistent": (empty_splats(), None)}

    scores = measure_psnr(
        model, candidates, [(c, None) for c in RING_CAMERAS], sphere=False, consistent=("consistent",)
    )

    assert scores["local"].model == 100 and scores["consistent"].model < 25


def test_masked_pixels_and_fully_masked_views_are_ignored():
    model = small_model(GAUSSIAN_POSITIONS, solid=(1.0, 1.0, 1.0), **INVISIBLE_SETTINGS)
    rgb = np.full((32, 32, 3), 255, np.uint8)
    rgb[:16] = 0
    half = np.repeat([False, True], 16)[:, None] & np.ones((32, 32), bool)
    views = [
        (c, view_of("photo", c, Picture(rgb, mask=mask)))
        for c, mask in zip(RING_CAMERAS, (half, np.zeros_like(half)), strict=False)
    ]
    assert measure_psnr(model, {}, views, sphere=False)["model"].photos == 100
    assert measure_psnr(model, {}, views[1:], sphere=False) == {}


def test_photos_are_scored_only_if_all_views_have_them():
    model = small_model(GAUSSIAN_POSITIONS)
    photo = Picture(np.zeros((32, 32, 3), np.uint8))
    views = [(RING_CAMERAS[0], view_of("photo", RING_CAMERAS[0], photo)), (RING_CAMERAS[1], None)]
    assert measure_psnr(model, {}, views, sphere=False)["model"].photos is None

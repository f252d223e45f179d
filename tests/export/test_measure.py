"""What an export loses is measured in the pictures of model and splats, on the same cameras."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scenes import camera_at, ring, small_model, view_of

from hyrfpack.export.background import background_picture
from hyrfpack.export.bake import bake
from hyrfpack.export.measure import _equirect_colors, measure_psnr
from hyrfpack.scene import Camera, Picture
from hyrfpack.splats.splats import Splats

POSITIONS = np.random.default_rng(0).uniform(-0.6, 0.6, (40, 3))
CAMERAS = ring(3)
FAINT = {"opacity_logits": -80.0}  # so that nothing is seen of it


def nothing() -> Splats:
    none = np.zeros((0, 3))
    return Splats(none, none, np.zeros((0, 4)), np.zeros(0), none[:, None])


def directions_picture(height: int) -> np.ndarray:
    """(H, 2H, 3) whose colour is the direction: (d + 1) / 2, by the closed form in `background_picture`."""
    a = 2 * np.pi * (np.arange(2 * height) + 0.5) / (2 * height) - np.pi
    b = (np.pi / 2 - np.pi * (np.arange(height) + 0.5) / height)[:, None]
    d = np.stack(np.broadcast_arrays(np.cos(b) * np.sin(a), -np.sin(b), np.cos(b) * np.cos(a)), -1)
    return ((d + 1) / 2).astype(np.float32)


def rays(camera: Camera) -> np.ndarray:
    """(H, W, 3) unit world directions through the middles of pixels."""
    columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    fx, fy, cx, cy = camera.intrinsics
    directions = np.stack([(columns - cx) / fx, (rows - cy) / fy, np.ones_like(columns)], -1) @ camera.rotation
    return directions / np.linalg.norm(directions, axis=-1, keepdims=True)


# -- a picture all around --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("target", [(0, 0, 1), (1, 0, 0), (-1, 0.3, 0.2), (0, 0, -1), (0, -1, 0), (0, 1, 0), (1, 1, 1)])
def test_cameras_see_the_direction_they_look_in_also_across_the_seam_and_at_the_poles(target):
    camera = camera_at((5.0, -3.0, 700.0), np.add((5.0, -3.0, 700.0), target), (0.1, 0.2, 1), width=31, height=24)
    seen = _equirect_colors(torch.from_numpy(directions_picture(180)), camera).numpy()
    expected = (rays(camera) + 1) / 2
    assert seen.shape == (24, 31, 3)
    # Half a pixel at the poles, where nothing lies beyond the last row.
    assert np.abs(seen - expected).max() < 0.5 * math.radians(1) / 2 + 1e-4
    assert np.abs(seen - expected).mean() < 5e-4


def test_the_seam_is_no_edge():
    picture = np.zeros((4, 8, 3), np.float32)
    picture[:, 0], picture[:, -1] = 1.0, 0.5
    camera = camera_at((0, 0, 0), (0, 0, -1), (0, -1, 0), width=101, height=1, focal=1e4)
    seen = _equirect_colors(torch.from_numpy(picture), camera)
    assert torch.allclose(seen[0, 50], torch.full((3,), 0.75), atol=1e-5)  # right between the two columns
    assert float(seen.diff(dim=1).abs().max()) < 1e-3


def test_the_models_background_as_a_picture_is_nearly_the_models_background():
    model = small_model(POSITIONS, fields=1.0, background=True, **FAINT)
    picture = background_picture(model, height=128)
    scores = measure_psnr(model, {"page": (nothing(), picture)}, [(c, None) for c in CAMERAS], sphere=True)
    assert scores["page"].model > 40
    without = measure_psnr(model, {"page": (nothing(), None)}, [(c, None) for c in CAMERAS], sphere=True)
    assert without["page"].model < 25


# -- scores ----------------------------------------------------------------------------------------------------------


def test_a_model_is_like_itself():
    model = small_model(POSITIONS, color_logits=0.7)  # of one colour: degree 0 is exact
    scores = measure_psnr(model, {"0": (bake(model, [])[3], None)}, [(c, None) for c in CAMERAS], sphere=False)
    assert scores["model"].model == 100 and scores["model"].photos is None
    assert scores["0"].model > 60 and scores["0"].photos is None


def test_scores_are_means_over_views_of_the_psnr():
    model = small_model(POSITIONS, solid=(1.0, 1.0, 1.0), **FAINT)
    photos = [np.full((32, 32, 3), level, np.uint8) for level in (204, 153)]
    views = [(c, view_of("photo", c, Picture(photo))) for c, photo in zip(CAMERAS, photos, strict=False)]
    scores = measure_psnr(model, {"nothing": (nothing(), None)}, views, sphere=False)
    expected = (-20 * math.log10(0.2) - 20 * math.log10(0.4)) / 2
    assert scores["model"].photos == pytest.approx(expected, abs=1e-4)
    assert scores["nothing"].photos == pytest.approx(expected, abs=1e-4)
    assert scores["nothing"].model == 100


def test_transparent_photos_lie_on_the_models_solid_colour():
    model = small_model(POSITIONS, solid=(1.0, 1.0, 1.0), **FAINT)
    clear = Picture(np.zeros((32, 32, 3), np.uint8), np.zeros((32, 32), np.uint8))
    scores = measure_psnr(model, {}, [(CAMERAS[0], view_of("photo", CAMERAS[0], clear))], sphere=False)
    assert scores["model"].photos == 100


def test_only_what_masks_leave_counts_and_views_without_it_do_not():
    model = small_model(POSITIONS, solid=(1.0, 1.0, 1.0), **FAINT)
    rgb = np.full((32, 32, 3), 255, np.uint8)
    rgb[:16] = 0
    half = np.repeat([False, True], 16)[:, None] & np.ones((32, 32), bool)
    views = [
        (c, view_of("photo", c, Picture(rgb, mask=mask)))
        for c, mask in zip(CAMERAS, (half, np.zeros_like(half)), strict=False)
    ]
    assert measure_psnr(model, {}, views, sphere=False)["model"].photos == 100
    assert measure_psnr(model, {}, views[1:], sphere=False) == {}


def test_photos_are_scored_where_all_views_have_them():
    model = small_model(POSITIONS)
    photo = Picture(np.zeros((32, 32, 3), np.uint8))
    views = [(CAMERAS[0], view_of("photo", CAMERAS[0], photo)), (CAMERAS[1], None)]
    assert measure_psnr(model, {}, views, sphere=False)["model"].photos is None

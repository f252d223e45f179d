"""The light of Gaussians accounts for every pixel."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scenes import ring, small_model

from hyrfpack.ops.rasterize import Gaussians3D, rasterize
from hyrfpack.ops.rasterize.light import measure_light
from hyrfpack.ops.viewport import Viewport
from hyrfpack.render import RenderSettings

RING_CAMERA = ring(1)[0]
IMAGE_SIZE = (RING_CAMERA.height, RING_CAMERA.width)
EXACT_SETTINGS = RenderSettings(transmittance_min=0).raster_settings(antialiased=False)


def cloud_in_view(offset: float = 0.0) -> tuple[Gaussians3D, Viewport]:
    """Return Gaussians around a point beside the origin, and the camera's viewport."""
    positions = np.random.default_rng(0).normal(offset, 0.4, (200, 3))
    model = small_model(positions, fields=0.3).requires_grad_(False)
    gaussians = model.decode_geometry().with_means(model.gaussians.positions)
    return gaussians, model.config.frame.local_viewport(RING_CAMERA)


@pytest.mark.parametrize("count", [1, 3, 7])
def test_light_and_what_passes_all_gaussians_add_up_to_each_weighted_pixel(count):
    gaussians, viewport = cloud_in_view()
    weights = torch.rand(count, *IMAGE_SIZE, generator=torch.Generator().manual_seed(0))
    light = measure_light(gaussians, viewport, weights, EXACT_SETTINGS)
    assert light.shape == (count, 200)
    black = torch.zeros_like(gaussians.means)
    blocked = (weights * (1 - rasterize(gaussians, black, viewport, EXACT_SETTINGS).transmittance.double())).sum((1, 2))
    assert blocked.min() > 1
    torch.testing.assert_close(light.double().sum(1), blocked, rtol=1e-5, atol=0)


def test_gaussians_out_of_view_have_no_light():
    gaussians, viewport = cloud_in_view(offset=1e4)
    assert not measure_light(gaussians, viewport, torch.ones(1, *IMAGE_SIZE), EXACT_SETTINGS).any()

"""The light of Gaussians accounts for every pixel."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scenes import ring, small_model

from hyrfpack.edit.light import measure_light
from hyrfpack.model import HybridModel
from hyrfpack.ops.rasterize import rasterize
from hyrfpack.render import RenderSettings

CAMERA = ring(1)[0]
SIZE = (CAMERA.height, CAMERA.width)
SETTINGS = RenderSettings(transmittance_min=0)


def cloud() -> HybridModel:
    positions = np.random.default_rng(0).normal(0, 0.4, (200, 3))
    return small_model(positions, fields=0.3).requires_grad_(False)


def transmittance(model: HybridModel) -> torch.Tensor:
    gaussians = model.decode_geometry().at(model.gaussians.positions)
    viewport = model.config.frame.local_viewport(CAMERA)
    raster = SETTINGS.raster_settings(model.config.antialiased)
    return rasterize(gaussians, torch.zeros_like(gaussians.means), viewport, raster).transmittance.double()


@pytest.mark.parametrize("count", [1, 3])
def test_light_and_what_passes_all_gaussians_add_up_to_each_weighted_pixel(count):
    model = cloud()
    weights = torch.rand(count, *SIZE, generator=torch.Generator().manual_seed(0))
    light = measure_light(model, CAMERA, weights, SETTINGS)
    assert light.shape == (count, len(model))
    blocked = (weights * (1 - transmittance(model))).sum((1, 2))
    assert blocked.min() > 1
    torch.testing.assert_close(light.double().sum(1), blocked.double(), rtol=1e-5, atol=0)


def test_gaussians_out_of_view_have_no_light():
    model = cloud()
    model.gaussians.positions += 1e4
    assert not measure_light(model, CAMERA, torch.ones(1, *SIZE), SETTINGS).any()

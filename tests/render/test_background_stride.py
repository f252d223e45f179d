"""The stride of the background that renders choose."""

import numpy as np
import pytest
import torch
from scenes import camera_at, small_model

from hyrfpack.render import RenderSettings, render_view
from hyrfpack.render.background_stride import MIN_PREDICTED_PSNR, choose_background_stride

WIDTH_PIXELS, HEIGHT_PIXELS = 128, 96


def chosen_stride(fields: float, transmittance: float = 1.0) -> int:
    """Return the stride that is chosen for an empty model, whose fields have weights of this size."""
    model = small_model(np.zeros((0, 3)), fields=fields, background=True)
    camera = camera_at((0, -3.0, 0), (0, -6.0, 0), width=WIDTH_PIXELS, height=HEIGHT_PIXELS, focal=80.0)
    viewport = model.config.frame.local_viewport(camera, torch.float32)
    return choose_background_stride(
        model, torch.full((HEIGHT_PIXELS, WIDTH_PIXELS), transmittance), viewport, threshold=1 / 512
    )


def test_a_uniform_background_gets_the_largest_stride():
    assert chosen_stride(0.0) == 4


def test_a_detailed_background_is_evaluated_at_each_pixel():
    assert chosen_stride(3.0) == 1


def test_a_nearly_hidden_background_is_interpolated():
    assert chosen_stride(3.0, transmittance=1 / 256) > 1


@pytest.mark.parametrize("fields", [0.05, 0.1, 0.2, 0.4, 0.8, 1.6])
def test_the_default_is_as_accurate_as_predicted(fields: float):
    model = small_model(np.zeros((0, 3)), fields=fields, background=True)
    camera = camera_at((0, -3.0, 0), (0, -6.0, 0), width=WIDTH_PIXELS, height=HEIGHT_PIXELS, focal=80.0)
    with torch.no_grad():
        found, exact = (
            render_view(model, camera, settings).rgb
            for settings in (RenderSettings(), RenderSettings(background_stride=1))
        )
    assert float((found - exact).square().mean()) < 10 ** (-(MIN_PREDICTED_PSNR - 3) / 10)

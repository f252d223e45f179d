"""Measure how much each Gaussian contributes to pictures."""

from __future__ import annotations

import torch
from torch import Tensor

from hyrfpack.model import HybridModel
from hyrfpack.ops.rasterize import rasterize
from hyrfpack.render import RenderSettings
from hyrfpack.scene import Camera


def measure_light(model: HybridModel, camera: Camera, weights: Tensor, settings: RenderSettings) -> Tensor:
    """Measure the light of each Gaussian in a view, weighted by pixel.

    The light of a Gaussian is the sum of its blending weights T alpha over the pixels. It is the derivative of the sum
    of all pixels by the Gaussian's colour.

    Args:
        model: the model.
        camera: the camera, in world units.
        weights: (k, H, W) with k from 1 to 3, maps of the weight of each pixel.
        settings: render settings.

    Returns:
        (k, N) in pixels, one row for each map.
    """
    gaussians = model.decode_geometry().at(model.gaussians.positions.detach())
    viewport = model.config.frame.local_viewport(camera, gaussians.means.dtype)
    colors = torch.zeros_like(gaussians.means, requires_grad=True)
    with torch.enable_grad():
        rgb = rasterize(gaussians, colors, viewport, settings.raster_settings(model.config.antialiased)).rgb
        total = (rgb[..., : len(weights)] * weights.permute(1, 2, 0)).sum()
    if not total.requires_grad:  # no Gaussian is in view
        return colors.new_zeros((len(weights), len(model)))
    return torch.autograd.grad(total, colors)[0][:, : len(weights)].T

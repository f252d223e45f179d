"""Measure how much each Gaussian contributes to pictures."""

from __future__ import annotations

import torch
from torch import Tensor

from hyrfpack.ops.rasterize import Gaussians3D, RasterSettings, rasterize
from hyrfpack.ops.viewport import Viewport


def measure_light(gaussians: Gaussians3D, viewport: Viewport, weights: Tensor, settings: RasterSettings) -> Tensor:
    """Measure the light of each Gaussian in a view, weighted by pixel.

    The light of a Gaussian is the sum of its blending weights T alpha over the pixels. It is the derivative of the sum
    of all pixels by the Gaussian's colour.

    Args:
        gaussians: the N Gaussians, in the units of the viewport.
        viewport: the camera.
        weights: (k, H, W) with k from 1 to 3, maps of the weight of each pixel.
        settings: settings of the rasteriser.

    Returns:
        (k, N) in pixels, one row for each map.
    """
    colors = torch.zeros_like(gaussians.means, requires_grad=True)
    with torch.enable_grad():
        rgb = rasterize(gaussians, colors, viewport, settings).rgb
        total = (rgb[..., : len(weights)] * weights.permute(1, 2, 0)).sum()
    if not total.requires_grad:  # no Gaussian is in view
        return colors.new_zeros((len(weights), len(colors)))
    return torch.autograd.grad(total, colors)[0][:, : len(weights)].T

"""Measure how much each Gaussian contributes to pictures."""

from __future__ import annotations

import torch
from torch import Tensor

from hyrfpack.ops.rasterize import rasterize
from hyrfpack.ops.rasterize.inputs import Gaussians3D, RasterSettings
from hyrfpack.ops.viewport import Viewport


def measure_light(gaussians: Gaussians3D, viewport: Viewport, weights: Tensor, settings: RasterSettings) -> Tensor:
    """Measure the light of each Gaussian in a view, weighted by pixel.

    The light of a Gaussian is the sum of its blending weights T alpha over the pixels. It is the derivative of the sum
    of all pixels by the Gaussian's colour.

    Args:
        gaussians: the N Gaussians, in the units of the viewport.
        viewport: the camera.
        weights: (k, H, W) with k >= 1, maps of the weight of each pixel. Three of them take one pass.
        settings: settings of the rasteriser.

    Returns:
        (k, N) in pixels, one row for each map.
    """
    passes = [_measure_light_of_three(gaussians, viewport, maps, settings) for maps in weights.split(3)]
    return torch.cat(passes)


def _measure_light_of_three(
    gaussians: Gaussians3D, viewport: Viewport, weights: Tensor, settings: RasterSettings
) -> Tensor:
    """Return `measure_light` of up to three maps, as many as a picture has channels."""
    colors = torch.zeros_like(gaussians.means, requires_grad=True)
    with torch.enable_grad():
        rgb = rasterize(gaussians, colors, viewport, settings).rgb
        total = (rgb[..., : len(weights)] * weights.permute(1, 2, 0)).sum()
    if not total.requires_grad:  # no Gaussian is in view
        return colors.new_zeros((len(weights), len(colors)))
    return torch.autograd.grad(total, colors)[0][:, : len(weights)].T

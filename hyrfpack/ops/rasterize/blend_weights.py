"""Computes each Gaussian's total blending weight in an image."""

from __future__ import annotations

import torch
from torch import Tensor

from hyrfpack.ops.dispatch import choose_implementation
from hyrfpack.ops.rasterize import rasterize
from hyrfpack.ops.rasterize.inputs import Gaussians3D, RasterSettings, check_shapes
from hyrfpack.ops.viewport import Viewport


@torch.no_grad()
def sum_blend_weights(
    gaussians: Gaussians3D,
    viewport: Viewport,
    settings: RasterSettings = RasterSettings(),  # noqa: B008 - frozen
    *,
    implementation: str = "auto",
) -> tuple[Tensor, Tensor]:
    """Sum each Gaussian's blending weight T alpha over the pixels of an image. Not differentiable.

    Arguments and errors are those of `rasterize`. Since an image is the sum of T alpha color, the result is the
    derivative of the sum of all pixels by the Gaussians' colours. "reference" computes it by autograd; "cpu" sums the
    weights in one forward pass, which takes half to two thirds of the time.

    Returns:
        (N,) the summed weights, in pixels, and the image's transmittance (H, W).

    Example:
        >>> shape = torch.tensor([[0.0, 0.0, 2.0]]), torch.tensor([[1.0, 0.0, 0.0, 0.0]]), torch.full((1, 3), 0.1)
        >>> viewport = Viewport(torch.eye(4), (32.0, 32.0, 16.0, 16.0), 32, 32)
        >>> weights, transmittance = sum_blend_weights(Gaussians3D(*shape, torch.tensor([0.9])), viewport)
        >>> bool(10 < weights[0] < 20), transmittance.shape
        (True, torch.Size([32, 32]))
    """
    check_shapes(gaussians)
    if choose_implementation("sum_blend_weights", implementation, ("reference", "cpu"), *gaussians) == "cpu":
        from hyrfpack.ops.rasterize import cpu

        return cpu.sum_blend_weights(gaussians, viewport, settings)
    with torch.enable_grad():
        colors = torch.zeros_like(gaussians.means, requires_grad=True)
        image = rasterize(gaussians, colors, viewport, settings)
        total, transmittance = image.rgb[..., 0].sum(), image.transmittance.detach()
        if not total.requires_grad:  # No Gaussian is visible.
            return torch.zeros_like(gaussians.opacities), transmittance
        return torch.autograd.grad(total, colors)[0][:, 0], transmittance

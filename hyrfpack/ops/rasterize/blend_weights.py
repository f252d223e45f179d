"""Computes each Gaussian's total blending weight in an image."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from hyrfpack.ops.dispatch import choose_implementation
from hyrfpack.ops.rasterize import INPUT_SHAPES, check_inputs, rasterize
from hyrfpack.ops.rasterize.reference import TRANSMITTANCE_MIN


@torch.no_grad()
def sum_blend_weights(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    camera_from_world: Tensor,
    intrinsics: tuple[float, float, float, float],
    width: int,
    height: int,
    *,
    near: float = 0.01,
    antialiased: bool = False,
    transmittance_min: float = TRANSMITTANCE_MIN,
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
        >>> view = torch.eye(4), (32.0, 32.0, 16.0, 16.0), 32, 32
        >>> weights, transmittance = sum_blend_weights(*shape, torch.tensor([0.9]), *view)
        >>> bool(10 < weights[0] < 20), transmittance.shape
        (True, torch.Size([32, 32]))
    """
    inputs = (means, quats, scales, opacities)
    view: Any = camera_from_world, intrinsics, width, height
    settings: dict[str, Any] = {"near": near, "antialiased": antialiased, "transmittance_min": transmittance_min}
    if choose_implementation(implementation, ("reference", "cpu"), *inputs) == "cpu":
        from hyrfpack.ops.rasterize import cpu

        check_inputs(
            dict(zip(INPUT_SHAPES, inputs, strict=False)), camera_from_world, width, height, near, transmittance_min
        )
        return cpu.sum_blend_weights(*inputs, *view, **settings)
    with torch.enable_grad():
        colors = torch.zeros_like(means, requires_grad=True)
        image = rasterize(means, quats, scales, opacities, colors, *view, **settings)
        total, transmittance = image.rgb[..., 0].sum(), image.transmittance.detach()
        if not total.requires_grad:  # No Gaussian is visible.
            return torch.zeros_like(opacities), transmittance
        return torch.autograd.grad(total, colors)[0][:, 0], transmittance

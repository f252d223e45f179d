"""The light that Gaussians send to a picture: how much of it is theirs."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from hyrfpack.ops.dispatch import choose_implementation
from hyrfpack.ops.rasterize import SHAPES, check, rasterize
from hyrfpack.ops.rasterize.reference import TRANSMITTANCE_MIN


@torch.no_grad()
def sent_light(
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
    """The light (N,) of each Gaussian in a picture, in pixels: the sum of T alpha over them. Not differentiable.

    A picture is the sum of T alpha color (see `rasterize`, whose arguments and errors these are), so this is the
    derivative of the sum of its pixels by the Gaussians' colours: what "reference" computes. On the CPU one pass
    that adds it up takes half to two thirds of the time.

    Returns:
        The light, and what of it passes all: the picture's transmittance (H, W).

    Example:
        >>> one = torch.tensor([[0.0, 0.0, 2.0]]), torch.tensor([[1.0, 0.0, 0.0, 0.0]]), torch.full((1, 3), 0.1)
        >>> sent, passed = sent_light(*one, torch.tensor([0.9]), torch.eye(4), (32.0, 32.0, 16.0, 16.0), 32, 32)
        >>> bool(10 < sent[0] < 20), passed.shape
        (True, torch.Size([32, 32]))
    """
    inputs = (means, quats, scales, opacities)
    view: Any = camera_from_world, intrinsics, width, height
    how: dict[str, Any] = {"near": near, "antialiased": antialiased, "transmittance_min": transmittance_min}
    if choose_implementation(implementation, ("reference", "cpu"), *inputs) == "cpu":
        from hyrfpack.ops.rasterize import cpu

        check(dict(zip(SHAPES, inputs, strict=False)), camera_from_world, width, height, near, transmittance_min)
        return cpu.sent_light(*inputs, *view, **how)
    with torch.enable_grad():
        colors = torch.zeros_like(means, requires_grad=True)
        drawn = rasterize(means, quats, scales, opacities, colors, *view, **how)
        total, passed = drawn.rgb[..., 0].sum(), drawn.transmittance.detach()
        if not total.requires_grad:  # nothing is drawn
            return torch.zeros_like(opacities), passed
        return torch.autograd.grad(total, colors)[0][:, 0], passed

"""Which Gaussians a view can show, and their colours."""

from __future__ import annotations

import torch
from torch import Tensor

from hyrfpack.model import Decoded, HybridModel
from hyrfpack.ops.poses import camera_center
from hyrfpack.ops.rasterize.cull import frustum_cull
from hyrfpack.render.renderer import RenderSettings
from hyrfpack.scene import Camera


def gaussians_in_view(model: HybridModel, camera: Camera) -> Tensor:
    """Return the ascending indices (n,) int64 of a model's Gaussians that `render_view` decodes by default.

    Raises:
        FloatingPointError: a position is NaN or infinite.
    """
    settings, positions = RenderSettings(), model.gaussians.positions.detach()
    viewport = model.config.frame.local_viewport(camera, positions.dtype)
    return frustum_cull(positions, viewport, settings.near, settings.cull_tolerance)


@torch.no_grad()
def colors_in_view(model: HybridModel, camera: Camera, decoded: Decoded) -> Tensor:
    """Return the colours (N, 3) of a model's Gaussians as `render_view` shows them to a camera.

    They hold for all models that differ from this one in nothing but shapes and opacities, see `Decoded.colors`.

    Args:
        decoded: result of `model.decode()`.

    Returns:
        (N, 3), zero for Gaussians that are not in view.

    Raises:
        FloatingPointError: a position is NaN or infinite.
    """
    positions = model.gaussians.positions
    index = gaussians_in_view(model, camera)
    viewpoint = camera_center(model.config.frame.local_viewport(camera, positions.dtype).pose).to(positions)
    colors = torch.zeros_like(positions)
    colors[index] = model.decode_colors(viewpoint, index, decoded.shading)
    return colors

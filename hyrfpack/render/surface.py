"""Renders the median depth of a view."""

from __future__ import annotations

import torch
from torch import Tensor

from hyrfpack.model import Decoded, HybridModel
from hyrfpack.ops.rasterize import median_depth as ops
from hyrfpack.parallel.pool import torch_on_one_thread
from hyrfpack.render.renderer import RenderSettings
from hyrfpack.scene import Camera


@torch_on_one_thread()
@torch.no_grad()
def render_median_depth(
    model: HybridModel, camera: Camera, decoded: Decoded, index: Tensor, settings: RenderSettings
) -> Tensor:
    """Render the depth along the view axis at which half of the light is lost, (H, W) in world units.

    It is 0 where Gaussians hold back less than half of the light; see `hyrfpack.ops.rasterize.median_depth`.

    Args:
        model: the model to render.
        camera: the camera, in world units.
        decoded: result of `model.decode()`.
        index: (n,) int64, the Gaussians to draw, such as those that `render_view` found to be visible.
        settings: render settings.
    """
    frame, positions = model.config.frame, model.gaussians.positions
    gaussians = decoded.geometry[index].at(positions[index])
    viewport = frame.local_viewport(camera, positions.dtype)
    return frame.scale * ops.median_depth(gaussians, viewport, settings.raster_settings(model.config.antialiased))

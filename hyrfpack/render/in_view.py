"""Which Gaussians a view can show."""

from __future__ import annotations

from torch import Tensor

from hyrfpack.model import HybridModel
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

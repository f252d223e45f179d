"""Render the original splats as references, and measure the light that they send."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from hyrfpack.evaluate.metrics import psnr
from hyrfpack.model import HybridModel
from hyrfpack.ops.rasterize.blend_weights import sum_blend_weights
from hyrfpack.ops.rasterize.cull import frustum_cull
from hyrfpack.parallel.pool import parallel_map, torch_on_one_thread
from hyrfpack.render import RenderSettings, render_view
from hyrfpack.scene import Camera
from hyrfpack.splats.draw import Drawable, draw

LIGHT_VIEWS_IN_MEMORY = 8


@torch_on_one_thread()
def mean_sent_light(drawable: Drawable, cameras: Sequence[Camera]) -> Tensor:
    """Return the light (N,) that each Gaussian sends to a picture: the sum of T alpha in pixels, mean over cameras."""
    total = torch.zeros(len(drawable.positions), device=drawable.device)
    settings = RenderSettings()

    def light(camera: Camera) -> tuple[Tensor, Tensor]:
        viewport = drawable.frame.local_viewport(camera)
        index = frustum_cull(drawable.positions, viewport, settings.near, settings.cull_tolerance)
        raster_settings = settings.raster_settings(drawable.antialiased)
        return index, sum_blend_weights(drawable.gaussians.select(index), viewport, raster_settings)[0]

    for first in range(0, len(cameras), LIGHT_VIEWS_IN_MEMORY):
        for index, sent in parallel_map(light, cameras[first : first + LIGHT_VIEWS_IN_MEMORY], drawable.device):
            total.index_add_(0, index, sent)
    return total / max(1, len(cameras))


@dataclass(frozen=True)
class ReferenceViews:
    """Reference renders of splats, against which models are compared.

    Attributes:
        cameras: the cameras that were rendered.
        pictures: the render of each camera, (H, W, 3) over black, clamped to [0, 1].
    """

    cameras: list[Camera]
    pictures: list[Tensor]

    @classmethod
    def from_splats(cls, drawable: Drawable, cameras: Sequence[Camera]) -> ReferenceViews:
        """Render the splats from cameras."""
        pictures = parallel_map(lambda camera: draw(drawable, camera).rgb.clamp(0, 1), cameras, drawable.device)
        return cls(list(cameras), pictures)

    @torch.no_grad()
    def psnr_per_view(self, model: HybridModel) -> list[float]:
        """Return the PSNR in dB of each view of a model, rendered over black on the device of the references."""
        decoded = model.decode()

        @torch.no_grad()  # gradient mode is kept per thread
        def score(index: int) -> float:
            rendered = render_view(model, self.cameras[index], decoded=decoded).rgb
            return psnr(rendered.clamp(0, 1), self.pictures[index])

        return parallel_map(score, range(len(self.cameras)), model.gaussians.positions.device)

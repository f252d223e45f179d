"""Find the Gaussians that masks of the photos show."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from hyrfpack.model import HybridModel
from hyrfpack.ops.rasterize.light import measure_light
from hyrfpack.progress import Progress, TaskEvent, ignore_progress
from hyrfpack.render import RenderSettings
from hyrfpack.scene import View

# Gaussians with less light than this in all photos together count as not shown: single pixels blend hundreds of them.
MIN_LIGHT_PIXELS = 1e-3


def share_of_light_in_masks(
    model: HybridModel, views: Sequence[View], progress: Progress = ignore_progress
) -> np.ndarray:
    """Compute which share of each Gaussian's light falls into the masks of photos.

    `measure_light` defines light.

    Args:
        model: the model.
        views: the photos, in the model's world coordinates. A photo without a mask counts as outside.
        progress: called with `TaskEvent`s.

    Returns:
        (N,) float64 in [0, 1]; 0 for a Gaussian that no photo shows.
    """
    gaussians = model.decode_geometry().with_means(model.gaussians.positions.detach())
    settings = RenderSettings().raster_settings(model.config.antialiased)
    light = gaussians.means.new_zeros((2, len(model)), dtype=torch.float64)
    for number, view in enumerate(views):
        progress(TaskEvent("comparing the model with masks", done=number, total=len(views)))
        mask = view.load().mask
        everywhere = light.new_ones((view.camera.height, view.camera.width), dtype=torch.float32)
        inside = torch.zeros_like(everywhere) if mask is None else torch.from_numpy(mask).to(everywhere)
        viewport = model.config.frame.local_viewport(view.camera, gaussians.means.dtype)
        light += measure_light(gaussians, viewport, torch.stack((inside, everywhere)), settings)
    shown = light[1] >= MIN_LIGHT_PIXELS
    return torch.where(shown, light[0] / light[1].clamp_min(MIN_LIGHT_PIXELS), 0).clamp(0, 1).numpy(force=True)

"""Find the Gaussians that masks of the photos show."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from hyrfpack.model import HybridModel
from hyrfpack.ops.rasterize import rasterize
from hyrfpack.progress import Progress, TaskEvent, ignore_progress
from hyrfpack.render import RenderSettings
from hyrfpack.scene import View

# Gaussians with less light than this in all photos together count as not shown: single pixels blend hundreds of them.
MIN_LIGHT_PIXELS = 1e-3


def share_of_light_in_masks(
    model: HybridModel, views: Sequence[View], progress: Progress = ignore_progress
) -> np.ndarray:
    """Compute which share of each Gaussian's light falls into the masks of photos.

    The light of a Gaussian in a photo is the sum of its blending weights T alpha over the pixels. It is the derivative
    of the sum of all pixels by the Gaussian's colour.

    Args:
        model: the model.
        views: the photos, in the model's world coordinates. A photo without a mask counts as outside.
        progress: called with `TaskEvent`s.

    Returns:
        (N,) float64 in [0, 1]; 0 for a Gaussian that no photo shows.
    """
    gaussians = model.decode_geometry().at(model.gaussians.positions.detach())
    settings = RenderSettings().raster_settings(model.config.antialiased)
    light = gaussians.means.new_zeros((2, len(model)), dtype=torch.float64)
    for number, view in enumerate(views):
        progress(TaskEvent("comparing the model with masks", done=number, total=len(views)))
        mask = view.load().mask
        inside = np.zeros((view.camera.height, view.camera.width)) if mask is None else mask
        viewport = model.config.frame.local_viewport(view.camera, gaussians.means.dtype)
        colors = torch.zeros_like(gaussians.means, requires_grad=True)
        with torch.enable_grad():
            rgb = rasterize(gaussians, colors, viewport, settings).rgb
            total = (rgb[..., 0] * _to_tensor(inside, rgb)).sum() + rgb[..., 1].sum()
        if total.requires_grad:  # otherwise no Gaussian is in view
            light += torch.autograd.grad(total, colors)[0][:, :2].T
    shown = light[1] >= MIN_LIGHT_PIXELS
    return torch.where(shown, light[0] / light[1].clamp_min(MIN_LIGHT_PIXELS), 0).clamp(0, 1).numpy(force=True)


def _to_tensor(mask: np.ndarray, like: Tensor) -> Tensor:
    return torch.from_numpy(mask.astype(np.float32)).to(like)

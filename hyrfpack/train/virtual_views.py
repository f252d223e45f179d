"""Virtual views: renders between few photos by several short runs, which a run is trained on beside the photos.

Few photos do not determine a scene, and what a run makes of the rest depends on its seed. The mean of the renders of
several runs is nearer to other photos than each of them. So short runs are trained first, and the mean of their renders
at viewpoints between the photos is a second target of the run itself. A virtual view has the exposure of the models,
without per-image gains.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch

from hyrfpack.cameras.view_sampling import interpolate_views, resize_camera
from hyrfpack.choices import CONSISTENT_EXPOSURE
from hyrfpack.model import HybridModel
from hyrfpack.render import RenderSettings, render_view
from hyrfpack.scene import Camera, Picture, View

VIRTUAL_VIEW_PREFIX = "virtual/"  # Names of photos are paths with an extension, so none is the name of a virtual view.
MAX_VIRTUAL_VIEW_PIXELS = 1_000_000  # Larger ones would take memory for details that teachers do not have.


def render_virtual_views(models: Sequence[HybridModel], cameras: Sequence[Camera], seed: int = 0) -> list[View]:
    """Render the mean of several models at a viewpoint between each camera and a neighbour.

    Args:
        models: models of the same photos; with or without a background, as all of them.
        cameras: the cameras of the photos, in world units, at least two.
        seed: random seed of the viewpoints, see `interpolate_views`.

    Returns:
        One view for each camera, of the size of its photo or smaller.
    """
    views = []
    for number, camera in enumerate(interpolate_views(cameras, seed, size_ratio=1.0)):
        small = resize_camera(camera, min(1.0, (MAX_VIRTUAL_VIEW_PIXELS / (camera.width * camera.height)) ** 0.5))
        views.append(View(f"{VIRTUAL_VIEW_PREFIX}{number}", small, _constant(_render_mean(models, small))))
    return views


def _constant(picture: Picture) -> Callable[[], Picture]:
    return lambda: picture


@torch.no_grad()
def _render_mean(models: Sequence[HybridModel], camera: Camera) -> Picture:
    """Return the mean of the models' renders of a view, transparent where models without a background are."""
    settings = RenderSettings(exposure=CONSISTENT_EXPOSURE)
    # Colours over black are those times alpha. The solid colour of the scene is laid behind the view in training.
    black = torch.zeros(3, device=models[0].gaussians.positions.device)
    renders = [render_view(model, camera, settings, solid=black) for model in models]
    rgb = torch.stack([render.rgb for render in renders]).mean(0).clamp(0, 1)
    if models[0].config.background:
        return Picture(_to_bytes(rgb))
    alpha = torch.stack([render.alpha for render in renders]).mean(0).clamp(0, 1)
    return Picture(_to_bytes((rgb / alpha[..., None].clamp_min(1e-6)).clamp(0, 1)), alpha=_to_bytes(alpha))


def _to_bytes(values: torch.Tensor) -> np.ndarray:
    return (values * 255).round().byte().cpu().numpy()

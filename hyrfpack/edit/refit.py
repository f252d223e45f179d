"""Train the Gaussians of a region on the photos while everything else stays as it is.

Hash grids and decoders belong to all Gaussians: a change of them would change the whole scene. So only the explicit
numbers of the region's Gaussians are trained: positions, colours, scales and opacities.
"""

from __future__ import annotations

import copy
import statistics
from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from hyrfpack.choices import AS_PHOTOGRAPHED
from hyrfpack.compress.finetune import fit_residual_gains
from hyrfpack.config.train import LearningRates
from hyrfpack.counts import format_count
from hyrfpack.data import PictureCache
from hyrfpack.device import upload
from hyrfpack.errors import HyrfError
from hyrfpack.evaluate.metrics import psnr, to_8bit
from hyrfpack.model import Geometry, HybridModel
from hyrfpack.model.exposure import apply_exposure_gains, clamp_colors
from hyrfpack.ops.rasterize import rasterize
from hyrfpack.ops.ssim import photometric_loss
from hyrfpack.parallel.pool import keep_freed_memory, parallel_map, torch_on_one_thread
from hyrfpack.progress import Progress, TaskEvent, ignore_progress
from hyrfpack.render import RenderSettings, render_view
from hyrfpack.scene import Camera, View
from hyrfpack.train.optimizer import Optimizer
from hyrfpack.train.resolution import ResolutionSchedule
from hyrfpack.train.trainer import shuffled

REFIT_RATES = LearningRates()
MIN_REGION_LIGHT_PIXELS = 16.0  # photos with less light of the region show too little of it to be trained on
MIN_REGION_LIGHT_SHARE = 0.5  # a pixel with a smaller share of light from the region does not count in its score


def refit_region(
    model: HybridModel,
    is_selected: np.ndarray,
    views: Sequence[View],
    steps: int,
    *,
    has_gains: bool = False,
    rates: LearningRates = REFIT_RATES,
    progress: Progress = ignore_progress,
) -> HybridModel:
    """Return a model whose selected Gaussians were trained on the photos. All other numbers are those of `model`.

    Each step takes one photo that shows the selected Gaussians, with the loss, the optimiser and the resolutions of
    training.

    Args:
        model: the model. It stays as it is.
        is_selected: (N,) bool, the Gaussians to train, at least one.
        views: photos, in the model's world coordinates.
        steps: number of steps.
        has_gains: whether the photos differ from the model in exposure, so that each photo's gains are fitted first.
        rates: learning rates.
        progress: called with `TaskEvent`s.

    Raises:
        HyrfError: no photo shows the selected Gaussians, a photo cannot be read, or the loss is not finite.
    """
    progress(TaskEvent("finding photos of the region", 0.0))
    with torch.no_grad():
        geometry = model.decode_geometry()
    light = parallel_map(lambda view: float(region_light_share(model, geometry, is_selected, view.camera).sum()), views)
    shown = [view for view, pixels in zip(views, light, strict=True) if pixels >= MIN_REGION_LIGHT_PIXELS]
    if not shown:
        raise HyrfError(
            f"none of the {len(views)} training photos shows the {format_count(is_selected.sum(), 'Gaussian')} of the "
            f"region in at least {MIN_REGION_LIGHT_PIXELS:g} pixels",
            fix="choose a larger region, or larger photos with `max_size`",
        )
    cache = PictureCache()
    gains = fit_residual_gains(model, shown, cache) if has_gains else {}
    trained = copy.deepcopy(model).requires_grad_(False)
    trained.gaussians.requires_grad_(True)
    frozen = torch.from_numpy(np.flatnonzero(~is_selected))
    originals = [values.detach()[frozen] for values in model.gaussians.parameters()]
    optimizer = Optimizer(trained, rates)
    resolution = ResolutionSchedule(shown, steps, len(model), has_coarse_background=False)
    order = map(resolution.reduce_view, shuffled(shown, 0, range(steps)), range(1, steps + 1))
    with closing(cache.stream(order)) as pictures, torch_on_one_thread(), keep_freed_memory():
        for step, (view, picture) in enumerate(pictures):
            progress(TaskEvent(f"training the region, step {step + 1}/{steps}", step / steps))
            solid = np.array(model.config.solid, np.float32)
            target, mask = upload(picture, solid, torch.device("cpu"))
            settings = replace(resolution.render_settings(view.camera, step + 1), exposure=AS_PHOTOGRAPHED)
            image = render_view(trained, view.camera, settings).rgb
            if view.name in gains:
                image = apply_exposure_gains(clamp_colors(image), gains[view.name])
            loss = photometric_loss(image, target, mask)
            if not loss.isfinite():
                raise HyrfError(f"{view.name}: the loss is not finite", fix="leave out this photo")
            if not loss.requires_grad:  # no Gaussian is in view at this resolution
                continue
            loss.backward()
            for values in trained.gaussians.parameters():
                assert values.grad is not None
                values.grad[frozen] = 0
            optimizer.step(step, steps)
    with torch.no_grad():
        for values, original in zip(trained.gaussians.parameters(), originals, strict=True):
            values[frozen] = original
    return trained.requires_grad_(False)


@torch.no_grad()
def region_light_share(model: HybridModel, geometry: Geometry, is_selected: np.ndarray, camera: Camera) -> Tensor:
    """Return the share (H, W), in [0, 1], of each pixel's light that comes from selected Gaussians.

    Args:
        model: the model.
        geometry: result of `model.decode_geometry()`.
        is_selected: (N,) bool, the Gaussians.
        camera: the camera, in world units.
    """
    gaussians = geometry.with_means(model.gaussians.positions)
    colors = torch.from_numpy(is_selected).to(gaussians.means)[:, None].expand(-1, 3).contiguous()
    viewport = model.config.frame.local_viewport(camera, gaussians.means.dtype)
    settings = RenderSettings().raster_settings(model.config.antialiased)
    return rasterize(gaussians, colors, viewport, settings).rgb[..., 0]


@torch.no_grad()
def score_region(models: Sequence[HybridModel], is_selected: np.ndarray, views: Sequence[View]) -> list[float] | None:
    """Return the PSNR in dB of models that differ in a region, on the pixels of photos that show it.

    A pixel counts if more than MIN_REGION_LIGHT_SHARE of its light comes from the region in one of the models.

    Args:
        models: the models, with the same number of Gaussians.
        is_selected: (N,) bool, the Gaussians of the region.
        views: photos, in the models' world coordinates.

    Returns:
        PSNR of each model; None if no photo shows the region.
    """
    pairs = [(model, model.decode()) for model in models]
    solid = np.array(models[0].config.solid, np.float32)
    scores = []
    for view in views:
        shares = torch.stack(
            [region_light_share(model, decoded.geometry, is_selected, view.camera) for model, decoded in pairs]
        )
        photo, mask = upload(view.load(), solid, shares.device)
        counted = shares.amax(0) > MIN_REGION_LIGHT_SHARE
        if mask is not None:
            counted &= mask
        if counted.any():
            renders = [render_view(model, view.camera, decoded=decoded).rgb for model, decoded in pairs]
            scores.append([psnr(to_8bit(rgb), photo, counted) for rgb in renders])
    return [statistics.fmean(values) for values in zip(*scores, strict=True)] if scores else None

"""Find floaters: Gaussians in front of the surfaces, whose light the photos contradict.

First only the opacities are fitted to the photos, and they may only fall, because otherwise one surface could replace
another. A pixel's colour is linear in each opacity, so Gaussians that the photos contradict fade. The loss charges for
light that is lost, so a Gaussian with the colour of what lies behind it keeps its opacity. Of the faded Gaussians,
those in front of the surface that the others show are floaters. The rest are superfluous parts of surfaces and stay.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from hyrfpack.data import PictureCache
from hyrfpack.data.reduced import reduce_view
from hyrfpack.device import upload
from hyrfpack.model import HybridModel
from hyrfpack.model.gaussians import logit
from hyrfpack.ops.rasterize.light import measure_light
from hyrfpack.progress import Progress, TaskEvent, ignore_progress
from hyrfpack.render import RenderSettings, render_view
from hyrfpack.scene import Camera, View, evenly_spaced
from hyrfpack.train.resolution import reduced_low_pass_variance

MAX_PHOTOS = 128
MAX_REDUCED_SIDE_PIXELS = 640
# Opacities are fitted in steps of one photo each: at least this many passes over all photos, and this many steps.
MIN_FADING_PASSES, MIN_FADING_STEPS = 16, 600
# Learning rates of the shares of opacity, at the first step and after the last one.
LEARNING_RATES = (0.1, 0.005)
ADAM_BETAS = (0.9, 0.99)
# Fading must lower the squared error, the mean of three channels, by this much for each pixel of light that is lost.
MIN_ERROR_PER_LIGHT = (4.5 / 255) ** 2
# A floater is nearer than the surface behind it by this ratio of the surface's depth, in this share of its views.
MIN_GAP_DEPTH_RATIO = 0.12
MIN_VIEW_SHARE_IN_FRONT = 0.15
# With a minimum of 0.01, many faded Gaussians would still be a haze, and others would change to compensate for it.
MIN_SUPPORTED_SHARE = 0.002
MIN_OPACITY, MAX_OPACITY = 1e-4, 1 - 1e-4  # limits for finite logits
MIN_SURFACE_ALPHA = 0.5  # pixels with less coverage show no surface, so every Gaussian lies in front of it
_FADING_PROGRESS_SHARE = 0.9  # comparing depths takes the rest of the time


def find_floaters(
    model: HybridModel, views: Sequence[View], min_opacity_share: float, progress: Progress = ignore_progress
) -> np.ndarray:
    """Return a mask (N,) of the floaters of a model.

    Args:
        model: the model. It stays as it is.
        views: photos of the scene, at least one.
        min_opacity_share: a Gaussian may be a floater if the photos leave it less than this share of its opacity, in
            (0, 1).
        progress: called with `TaskEvent`s.

    Raises:
        HyrfError: a photo cannot be read, or a number of the model is NaN or infinite.
    """
    longest = max(max(view.camera.width, view.camera.height) for view in views)
    factor = math.ceil(longest / MAX_REDUCED_SIDE_PIXELS)
    settings = RenderSettings(low_pass_variance=reduced_low_pass_variance(factor))
    reduced = [reduce_view(view, factor) for view in evenly_spaced(views, MAX_PHOTOS)]
    faded = _fit_supported_shares(model, reduced, settings, progress) < min_opacity_share
    if not faded.any():
        return faded
    progress(TaskEvent("comparing depths", _FADING_PROGRESS_SHARE))
    others = model.subset(torch.from_numpy(np.flatnonzero(~faded))).requires_grad_(False)
    positions = model.config.frame.to_world(model.gaussians.positions.detach().numpy()[faded])
    cameras = [view.camera for view in reduced]
    faded[faded] = _share_of_views_in_front(positions, others, cameras, settings) > MIN_VIEW_SHARE_IN_FRONT
    return faded


def _fit_supported_shares(
    model: HybridModel, views: Sequence[View], settings: RenderSettings, progress: Progress
) -> np.ndarray:
    """Fit the share (N,) of its opacity that the photos leave to each Gaussian, `MIN_SUPPORTED_SHARE` to 1.

    The shares s minimise the squared error of the photos plus the cost of lost light: `MIN_ERROR_PER_LIGHT` (1 - s) L
    for a Gaussian with the light L, in pixels of a mean view. A logit instead of a share would leave opaque Gaussians
    almost no gradient.
    """
    faded = copy.deepcopy(model).requires_grad_(False)
    before = model.decode_geometry().opacities.detach()[:, None].clamp(MIN_OPACITY, MAX_OPACITY)
    field_logits = logit(before) - faded.gaussians.opacity_logits
    del faded.gaussians.opacity_logits  # the logits become a function of the shares instead of a parameter
    light = _mean_light(model, views, settings)
    shares = torch.ones_like(before).requires_grad_(True)
    optimizer = torch.optim.Adam([shares], betas=ADAM_BETAS)
    solid = np.array(model.config.solid, np.float32)
    rng = np.random.default_rng(0)
    passes = max(MIN_FADING_PASSES, math.ceil(MIN_FADING_STEPS / len(views)))
    steps = passes * len(views)
    shuffled = (views[i] for _ in range(passes) for i in rng.permutation(len(views)))
    for step, (view, picture) in enumerate(PictureCache().stream(shuffled)):
        progress(TaskEvent("comparing with photos", _FADING_PROGRESS_SHARE * step / steps))
        photo, mask = upload(picture, solid, shares.device)
        faded.gaussians.opacity_logits = logit(shares * before) - field_logits
        rgb = render_view(faded, view.camera, settings).rgb
        if not rgb.requires_grad:  # no Gaussian is in view
            continue
        kept_light = (light * shares).sum() / photo[..., 0].numel()
        optimizer.zero_grad()
        (_squared_error(rgb, photo, mask) - MIN_ERROR_PER_LIGHT * kept_light).backward()
        optimizer.param_groups[0]["lr"] = np.interp(step, (0, steps), LEARNING_RATES)
        optimizer.step()
        with torch.no_grad():
            shares.clamp_(MIN_SUPPORTED_SHARE, 1)
    return shares.detach()[:, 0].numpy()


@torch.no_grad()
def _mean_light(model: HybridModel, views: Sequence[View], settings: RenderSettings) -> Tensor:
    """Return the light (N, 1) of the Gaussians in pixels, the mean of all views."""
    gaussians = model.decode_geometry().with_means(model.gaussians.positions)
    raster_settings = settings.raster_settings(model.config.antialiased)
    light = gaussians.means.new_zeros((1, len(model)))
    for view in views:
        viewport = model.config.frame.local_viewport(view.camera, gaussians.means.dtype)
        everywhere = light.new_ones((1, view.camera.height, view.camera.width))
        light += measure_light(gaussians, viewport, everywhere, raster_settings) / len(views)
    return light.T


def _squared_error(rgb: Tensor, photo: Tensor, mask: Tensor | None) -> Tensor:
    """Return the mean squared error of a render (H, W, 3), after its channels are scaled to the exposure of the photo.

    Without the scaling, opacities would change to make pictures brighter or darker.
    """
    weight = rgb.new_ones(()) if mask is None else mask[..., None].to(rgb)
    with torch.no_grad():
        gains = (weight * rgb * photo).sum((0, 1)) / (weight * rgb * rgb).sum((0, 1)).clamp_min(1e-9)
    return (weight * (gains * rgb - photo).square()).mean()


def _share_of_views_in_front(
    positions: np.ndarray, others: HybridModel, cameras: Sequence[Camera], settings: RenderSettings
) -> np.ndarray:
    """Return the share (n,) of views in which points lie clearly in front of the surface that other Gaussians show.

    Views in which a point is hidden or outside of the picture do not count; without any view the share is 0.

    Args:
        positions: (n, 3) world positions.
        others: the Gaussians that show the surface.
        cameras: cameras of the views.
        settings: settings of the renders.
    """
    in_front_count, visible_count = np.zeros(len(positions)), np.zeros(len(positions))
    for camera in cameras:
        with torch.no_grad():
            rendering = render_view(others, camera, replace(settings, transmittance_min=0), depth=True)
        assert rendering.depth is not None
        surface = torch.where(rendering.alpha < MIN_SURFACE_ALPHA, torch.inf, rendering.depth).numpy()
        x, y, z = camera.project(positions)
        inside = np.flatnonzero(camera.in_picture(x, y, z))
        depths, behind = z[inside], surface[y[inside].astype(np.int64), x[inside].astype(np.int64)]
        in_front_count[inside] += depths < (1 - MIN_GAP_DEPTH_RATIO) * behind
        visible_count[inside] += depths < (1 + MIN_GAP_DEPTH_RATIO) * behind
    return in_front_count / np.maximum(visible_count, 1)

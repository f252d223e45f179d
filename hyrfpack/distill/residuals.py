"""Exact residuals: what the fields of a model leave to correct, so that its Gaussians equal given splats."""

from __future__ import annotations

from dataclasses import replace

import torch

from hyrfpack.distill.initialize import COLOR_RANGE, MAX_OPACITY
from hyrfpack.model import HybridModel
from hyrfpack.model.gaussians import Gaussians, logit
from hyrfpack.model.hybrid import scale_bounds
from hyrfpack.model.shape_residuals import shape_residuals
from hyrfpack.splats.draw import Drawable
from hyrfpack.splats.harmonics import SH_C0

# Smaller scales, in local units, are raised to this: a quarter of a pixel if the box is 1000 pixels wide.
MIN_SCALE_LOCAL = 1e-4


@torch.no_grad()
def exact_model(model: HybridModel, drawable: Drawable) -> HybridModel:
    """Return a model of splats with the fields of `model`, whose residuals make its Gaussians equal the splats.

    Shapes and colours are exact. Scales below MIN_SCALE_LOCAL or above what the model can store, and opacities above
    MAX_OPACITY, are clamped.

    Args:
        model: a model in the frame of `drawable`, whose radiance field is constant zero.
        drawable: the splats, on the device of the model.
    """
    positions, harmonics = drawable.positions, drawable.harmonics
    raw = model.geometry(model.cube_coords(positions))
    sizes = drawable.scales.clamp_min(MIN_SCALE_LOCAL) / scale_bounds(positions, model.config)
    shapes, scale_logits = shape_residuals(raw, logit(sizes), drawable.quats)
    opacity_logits = logit(drawable.opacities[:, None].clamp_max(MAX_OPACITY)) - raw[:, :1]
    constant = 0.5 + SH_C0 * harmonics[:, 0]
    color_logits = logit(constant.clamp(*COLOR_RANGE))
    rest = (constant - torch.sigmoid(color_logits)) / SH_C0
    colors = torch.cat((rest[:, None], harmonics[:, 1:]), dim=1).flatten(1)
    gaussians = Gaussians(positions, color_logits, scale_logits, opacity_logits, shapes, colors)
    return model.with_gaussians(gaussians, replace(model.config, residual_degree=drawable.degree))

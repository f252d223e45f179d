"""The model that equals given splats: residuals hold their shapes and colours, and the fields are zero."""

from __future__ import annotations

import torch

from hyrfpack.model import HashGridConfig, HybridModel, ModelConfig
from hyrfpack.model.gaussians import Gaussians, logit
from hyrfpack.model.hybrid import scale_bounds
from hyrfpack.model.shape_residuals import compute_shape_residuals
from hyrfpack.ops.rasterize.reference import ALPHA_MAX
from hyrfpack.splats.draw import Drawable
from hyrfpack.splats.harmonics import SH_C0

# Smaller scales, in local units, are raised to this: a quarter of a pixel if the box is 1000 pixels wide.
MIN_SCALE_LOCAL = 1e-4
# Colours are clamped to this range before their logits are taken; residuals hold the rest.
COLOR_RANGE = 0.005, 0.995
# Fields that are zero everywhere get the smallest hash grid and decoder.
ZERO_FIELD_GRID = HashGridConfig(4, levels=1, base=2, finest=2)
ZERO_FIELD_HIDDEN = 1
FIELD_OUTPUTS = 8


@torch.no_grad()
def exact_model(drawable: Drawable) -> HybridModel:
    """Return a model whose Gaussians equal splats.

    Shapes and colours are exact. Scales below MIN_SCALE_LOCAL or above what a model can store, and opacities above
    ALPHA_MAX, are clamped.

    Args:
        drawable: the splats; the model is on their device.
    """
    positions, harmonics = drawable.positions, drawable.harmonics
    config = ModelConfig(
        frame=drawable.frame,
        geometry=ZERO_FIELD_GRID,
        radiance=ZERO_FIELD_GRID,
        hidden=ZERO_FIELD_HIDDEN,
        background=False,
        direction_encoding="sh",
        antialiased=drawable.antialiased,
        residual_degree=drawable.degree,
    )
    sizes = drawable.scales.clamp_min(MIN_SCALE_LOCAL) / scale_bounds(positions, config)
    shapes, scale_logits = compute_shape_residuals(
        positions.new_zeros(len(positions), FIELD_OUTPUTS), logit(sizes), drawable.quats
    )
    opacity_logits = logit(drawable.opacities[:, None].clamp_max(ALPHA_MAX))
    constant = 0.5 + SH_C0 * harmonics[:, 0]
    color_logits = logit(constant.clamp(*COLOR_RANGE))
    rest = (constant - torch.sigmoid(color_logits)) / SH_C0  # the fields add sigmoid(0 + logit)
    colors = torch.cat((rest[:, None], harmonics[:, 1:]), dim=1).flatten(1)
    model = HybridModel(config, Gaussians(positions, color_logits, scale_logits, opacity_logits, shapes, colors))
    for field in (model.geometry, model.radiance):
        for values in field.parameters():
            values.zero_()
    return model.to(positions.device)

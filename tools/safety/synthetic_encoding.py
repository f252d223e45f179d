"""Encode models in profile `compact` without rendering: the sensitivities are random, or equal for all numbers.

Golden files, recorded sizes, hostile files and tests use this module, so that their bytes do not depend on pictures.
`hyrfpack.compress_model` measures the sensitivities instead.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from unittest.mock import patch

import numpy as np

from hyrfpack.compress import plan as planning
from hyrfpack.compress.quantize import plan_and_quantize
from hyrfpack.compress.sensitivity import Sensitivity, removal_error
from hyrfpack.format import encode_model
from hyrfpack.format.arrays import decoder_widths, grid_configs, to_arrays
from hyrfpack.format.compact.quantized import QuantizedModel
from hyrfpack.model import HybridModel
from hyrfpack.model.residuals import SHAPE_RESIDUALS
from hyrfpack.quant.morton import MAX_BITS_PER_AXIS

DEFAULT_DISTORTION = 1e-5
# The sums of the sensitivities over all numbers of one kind are about as in trained models.
TOTAL_POSITION_SENSITIVITY = 300.0
TOTAL_LOGIT_SENSITIVITY = 0.01
TOTAL_TABLE_SENSITIVITY = 0.01
TOTAL_DECODER_SENSITIVITY = 1.0
LOG_SENSITIVITY_STD = 1.5


def draw_sensitivity(model: HybridModel) -> Sensitivity:
    """Draw log-normal sensitivities with a fixed seed.

    All numbers of a Gaussian share one factor. The sensitivity of a table row is proportional to the number of reads by
    the Gaussians.
    """
    rng = np.random.default_rng(0)
    shares = np.exp(LOG_SENSITIVITY_STD * rng.normal(size=len(model))) / max(len(model), 1)
    cube_coords = model.cube_coords(model.gaussians.positions.detach().double()).numpy()
    points = 2 * np.minimum(cube_coords * (1 << MAX_BITS_PER_AXIS), (1 << MAX_BITS_PER_AXIS) - 1).astype(np.int64) + 1
    fields = {}
    for group, grid in grid_configs(model.config).items():
        usage = grid.count_row_reads(points, MAX_BITS_PER_AXIS + 1)
        fields[group] = (TOTAL_TABLE_SENSITIVITY * usage / max(usage.sum(), 1)).repeat(2)
    for group, widths in decoder_widths(model.config).items():
        count = sum((fan_in + 1) * fan_out for fan_in, fan_out in pairwise(widths))
        fields[group] = TOTAL_DECODER_SENSITIVITY / count * np.exp(LOG_SENSITIVITY_STD * rng.normal(size=count))
    removals = removal_error(
        model.decode_geometry().opacities.detach().double().numpy(), TOTAL_LOGIT_SENSITIVITY * shares
    )
    explicit = TOTAL_LOGIT_SENSITIVITY * shares
    sensitivity = Sensitivity(
        TOTAL_POSITION_SENSITIVITY * shares, explicit, explicit, explicit, removals=removals, fields=fields
    )
    if model.config.residual_degree is None:
        return sensitivity
    return replace(sensitivity, shapes=explicit[:, None].repeat(SHAPE_RESIDUALS, 1), harmonics=explicit)


def quantize_with_drawn_sensitivity(
    model: HybridModel, distortion: float = DEFAULT_DISTORTION, prune: bool = True, layered: bool = False
) -> QuantizedModel:
    """Quantise a model by `draw_sensitivity`.

    Args:
        model: the model.
        distortion: the target distortion (mean squared error).
        prune: whether Gaussians may be pruned.
        layered: whether the Gaussians are split into layers even if they are few.
    """
    gaussians, share = (2, 0.01) if layered else (planning.MIN_LAYER_GAUSSIANS, planning.MIN_LAYER_SHARE)
    with patch.multiple(planning, MIN_LAYER_GAUSSIANS=gaussians, MIN_LAYER_SHARE=share):
        return plan_and_quantize(model, draw_sensitivity(model), distortion, prune)


def quantize_uniformly(model: HybridModel, step: float) -> QuantizedModel:
    """Quantise all numbers of all Gaussians and fields, including unused ones, with steps within 1/15 of `step`."""
    arrays = to_arrays(model)
    ones = {group: np.ones(values.size) for group, values in arrays.items()}
    distortion = step**2 / 12 * sum(values.size for values in arrays.values())
    unit = np.ones(len(model))
    sensitivity = Sensitivity(unit, unit, unit, unit, removals=unit, fields=ones)
    return plan_and_quantize(model, sensitivity, distortion, prune=False)


def encode(model: HybridModel, profile: str, provenance: dict | None = None, **settings: object) -> bytes:
    """Encode a model in any profile; the settings of "compact" are those of `quantize_with_drawn_sensitivity`."""
    if profile == "compact":
        settings = {"quantized": quantize_with_drawn_sensitivity(model, **settings)}
    return encode_model(model, profile, provenance, **settings)

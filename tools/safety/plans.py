"""Decisions of profile `compact` without renders: how much each number matters is drawn, or the same for all.

For golden files, recorded sizes, hostile files and tests: no picture decides about their bytes. `hyrfpack.compress`
measures instead.
"""

from __future__ import annotations

from itertools import pairwise
from unittest.mock import patch

import numpy as np

from hyrfpack.compress import plan as planning
from hyrfpack.compress.quantize import decide
from hyrfpack.compress.sensitivity import Sensitivity, removal_error
from hyrfpack.format import encode_model
from hyrfpack.format.arrays import decoder_widths, grid_configs, to_arrays
from hyrfpack.format.compact.quantized import QuantizedModel
from hyrfpack.model import HybridModel
from hyrfpack.quant.morton import MAX_BITS_PER_AXIS

DISTORTION = 1e-5
# Sums over all numbers of a kind, as they are in trained models, about.
POSITIONS, LOGITS, TABLE, DECODER = 300.0, 0.01, 0.01, 1.0
SPREAD = 1.5  # standard deviation of the logarithms


def drawn_sensitivity(model: HybridModel, seed: int = 0) -> Sensitivity:
    """A fixed draw: log-normal, a Gaussian's numbers alike, rows of tables by how often Gaussians read them."""
    rng = np.random.default_rng(seed)
    shares = np.exp(SPREAD * rng.normal(size=len(model))) / max(len(model), 1)
    places = model.cube_coords(model.gaussians.positions.detach().double()).numpy()
    points = 2 * np.minimum(places * (1 << MAX_BITS_PER_AXIS), (1 << MAX_BITS_PER_AXIS) - 1).astype(np.int64) + 1
    fields = {}
    for group, grid in grid_configs(model.config).items():
        usage = grid.count_row_reads(points, MAX_BITS_PER_AXIS + 1)
        fields[group] = (TABLE * usage / max(usage.sum(), 1)).repeat(2)
    for group, widths in decoder_widths(model.config).items():
        count = sum((fan_in + 1) * fan_out for fan_in, fan_out in pairwise(widths))
        fields[group] = DECODER / count * np.exp(SPREAD * rng.normal(size=count))
    removals = removal_error(model.decode_geometry().opacities.detach().double().numpy(), LOGITS * shares)
    return Sensitivity(POSITIONS * shares, *[LOGITS * shares] * 3, removals, fields)


def drawn(
    model: HybridModel, distortion: float = DISTORTION, prune: bool = True, layered: bool = False
) -> QuantizedModel:
    """What `drawn_sensitivity` leads to; with `layered` in layers however few the Gaussians are."""
    least, most = (2, 100) if layered else (planning.MIN_LAYER_GAUSSIANS, planning.MAX_LAYERS)
    with patch.multiple(planning, MIN_LAYER_GAUSSIANS=least, MAX_LAYERS=most):
        return decide(model, drawn_sensitivity(model), distortion, prune)


def even(model: HybridModel, step: float) -> QuantizedModel:
    """All Gaussians, and all numbers, those that nobody reads included, in steps within 1/15 of `step`."""
    arrays = to_arrays(model)
    ones = {group: np.ones(values.size) for group, values in arrays.items()}
    distortion = step**2 / 12 * sum(values.size for values in arrays.values())
    return decide(model, Sensitivity(*np.ones((5, len(model))), ones), distortion, prune=False)


def encode(model: HybridModel, profile: str, provenance: dict | None = None, **settings: object) -> bytes:
    """`encode_model` with any profile; settings of "compact" are those of `drawn`."""
    if profile == "compact":
        settings = {"quantized": drawn(model, **settings)}
    return encode_model(model, profile, provenance, **settings)

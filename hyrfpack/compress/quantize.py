"""A model's numbers as they will be stored: what is decided, by rate and distortion, before any byte is written."""

from __future__ import annotations

from collections.abc import Callable, Collection
from functools import partial
from typing import Any

import numpy as np
import torch
from scipy.special import expit

from hyrfpack.compress.channels import ErrorModel, quantize_channel
from hyrfpack.compress.groups import quantize_groups
from hyrfpack.compress.plan import make_plan
from hyrfpack.compress.sensitivity import Sensitivity
from hyrfpack.format.arrays import to_arrays
from hyrfpack.format.compact.channels import MAX_ABS_CHANNEL_VALUE
from hyrfpack.format.compact.plan import Plan
from hyrfpack.format.compact.quantized import LOGIT_COLUMNS, QuantizedModel
from hyrfpack.format.sections import COLORS, DECODER_SECTIONS, LOGIT_SECTIONS, OPACITIES, SCALES, TABLE_SECTIONS
from hyrfpack.model import HybridModel
from hyrfpack.parallel.pool import run_jobs

SATURATED = 8.0  # an opacity's total logit beyond it looks like it: sigmoid is within 3.4e-4 of its end
OPACITY_REACH = 4  # where opacity is near 0 or 1 logits may move far


def decide(model: HybridModel, sensitivity: Sensitivity, distortion: float, prune: bool = True) -> QuantizedModel:
    """Plan a model and quantise it, ready to be encoded. Arguments as `make_plan`."""
    plan = make_plan(model, sensitivity, distortion, prune)
    return quantize(plan.apply(model), plan, sensitivity)


def quantize(
    model: HybridModel,
    plan: Plan,
    sensitivity: Sensitivity,
    *,
    reach: int = 1,
    like: QuantizedModel | None = None,
    sections: Collection[str] = (*LOGIT_SECTIONS, *TABLE_SECTIONS, *DECODER_SECTIONS),
) -> QuantizedModel:
    """Quantise a planned model (`plan.apply`) by rate and distortion.

    Args:
        sensitivity: that the plan was made by.
        reach: how many steps from the nearest symbol are tried; 0 takes the nearest.
        like: an earlier result of the same plan, whose weights of predictions are taken over.
        sections: what to quantise; a file takes all.

    Raises:
        HyrfError: a parameter is NaN or infinite.
    """
    arrays = {group: values.astype(np.float64) for group, values in to_arrays(model).items()}
    sensitivity, d = sensitivity.of(plan.kept), plan.distortion_per_number
    jobs: dict[str, Callable[[], Any]] = {
        group: partial(quantize_groups, arrays[group].ravel(), groups, sensitivity.fields[group], d, reach)
        for group, groups in plan.groups.items()
        if group in sections
    }
    logits = [group for group in LOGIT_SECTIONS if group in sections]
    weights = {COLORS: sensitivity.colors, SCALES: sensitivity.scales, OPACITIES: sensitivity.opacities}
    error: ErrorModel | None = None
    if COLORS in logits:  # cut before it is turned: a colour far outside would come back as another
        arrays[COLORS] = np.clip(
            arrays[COLORS], -MAX_ABS_CHANNEL_VALUE / 2, MAX_ABS_CHANNEL_VALUE / 2
        ) @ plan.basis.astype(np.float64)
    if OPACITIES in logits:
        numbers, error = opacity_error(model, arrays[OPACITIES][:, 0], sensitivity.opacities)
        arrays[OPACITIES] = numbers[:, None]
    stop = 0
    for layer, classes in enumerate(layer.points.classes for layer in plan.layers):
        part = slice(stop, stop := stop + len(classes))
        for group in logits:
            opaque = group == OPACITIES
            cost = partial(_of_later, error, part.start) if opaque and error else None
            far = reach and OPACITY_REACH if opaque else reach
            for column, values in enumerate(arrays[group][part].T):
                weight = None if like is None else like.channels[layer][group][column].weight
                jobs[f"{group} {layer} {column}"] = partial(
                    quantize_channel, values, classes, weights[group][part], d, cost, far, weight
                )
    done = run_jobs(jobs)
    channels = [
        {group: [done[f"{group} {layer} {column}"] for column in range(LOGIT_COLUMNS[group])] for group in logits}
        for layer in range(len(plan.layers))
    ]
    return QuantizedModel(plan, channels, {group: done[group] for group in plan.groups if group in sections})


def _of_later(error: ErrorModel, start: int, places: Any, candidates: np.ndarray) -> np.ndarray:
    """The error of Gaussians that are counted from `start` on."""
    return error(places + start, candidates)


@torch.no_grad()
def opacity_error(model: HybridModel, logits: np.ndarray, sensitivity: np.ndarray) -> tuple[np.ndarray, ErrorModel]:
    """Opacity logits (M,) without tails that nobody sees, and the error of candidates, counted in opacity."""
    neural = model.geometry(model.cube_coords(model.gaussians.positions))[:, 0].double().cpu().numpy()
    opacities = expit(neural + logits)
    weights = sensitivity / np.maximum(opacities * (1 - opacities), 1e-4) ** 2

    def error(places: Any, candidates: np.ndarray) -> np.ndarray:
        return weights[places] * (expit(neural[places] + candidates) - opacities[places]) ** 2

    return np.clip(logits, -SATURATED - neural, SATURATED - neural), error

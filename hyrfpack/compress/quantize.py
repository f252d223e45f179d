"""Quantise a planned model: choose all steps and symbols by rate and distortion, before they are coded."""

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
from hyrfpack.compress.residuals import quantize_residuals, residual_sensitivity, split_colors
from hyrfpack.compress.sensitivity import Sensitivity
from hyrfpack.format.arrays import residual_widths, to_arrays
from hyrfpack.format.compact.channels import MAX_ABS_CHANNEL_VALUE
from hyrfpack.format.compact.plan import Plan
from hyrfpack.format.compact.quantized import LOGIT_COLUMNS, QuantizedModel
from hyrfpack.format.sections import (
    COLORS,
    DECODER_SECTIONS,
    HARMONICS,
    LOGIT_SECTIONS,
    OPACITIES,
    RESIDUAL_SECTIONS,
    SCALES,
    TABLE_SECTIONS,
)
from hyrfpack.model import HybridModel
from hyrfpack.parallel.pool import run_jobs

# Total opacity logits are clamped to this magnitude, where the sigmoid is within 3.4e-4 of 0 or 1.
SATURATION_LOGIT = 8.0
# Opacity logits are searched further from the nearest symbol, because near opacity 0 or 1 they hardly matter.
OPACITY_REACH_STEPS = 4


def plan_and_quantize(
    model: HybridModel, sensitivity: Sensitivity, distortion: float, prune: bool = True
) -> QuantizedModel:
    """Plan a model and quantise it, ready to be encoded. The arguments are those of `make_plan`."""
    plan = make_plan(model, sensitivity, distortion, prune)
    return quantize(plan.apply(model), plan, sensitivity)


def quantize(
    model: HybridModel,
    plan: Plan,
    sensitivity: Sensitivity,
    *,
    reach: int = 1,
    sections: Collection[str] = (*LOGIT_SECTIONS, *RESIDUAL_SECTIONS, *TABLE_SECTIONS, *DECODER_SECTIONS),
    field_logits: np.ndarray | None = None,
) -> QuantizedModel:
    """Quantise a planned model (`plan.apply`) by rate and distortion.

    Args:
        model: the planned model.
        plan: its plan.
        sensitivity: the sensitivities that the plan was made from.
        reach: distance in steps of the furthest candidate from the nearest symbol; 0 takes the nearest.
        sections: the sections to quantise; a file needs all of them.
        field_logits: result of `field_opacity_logits(model)`, if it is known.

    Raises:
        HyrfError: a parameter is NaN or infinite.
    """
    arrays = {group: values for group, values in to_arrays(model).items() if group in sections}
    sensitivity, d = sensitivity.subset(plan.kept), plan.distortion_per_number
    jobs: dict[str, Callable[[], Any]] = {
        group: partial(quantize_groups, arrays[group].ravel(), groups, sensitivity.fields[group], d, reach)
        for group, groups in plan.groups.items()
        if group in sections
    }
    for group in arrays.keys() & {*LOGIT_SECTIONS, *RESIDUAL_SECTIONS}:
        arrays[group] = arrays[group].astype(np.float64)
    residuals = [group for group in residual_widths(model.config) if group in sections]
    if HARMONICS in residuals:
        arrays[HARMONICS] = split_colors(arrays[HARMONICS], plan.basis)
    logits = [group for group in LOGIT_SECTIONS if group in sections]
    weights = {COLORS: sensitivity.colors, SCALES: sensitivity.scales, OPACITIES: sensitivity.opacities}
    error: ErrorModel | None = None
    if COLORS in logits:  # Colours are clamped before the change of basis; clamping after it would change the hue.
        arrays[COLORS] = np.clip(
            arrays[COLORS], -MAX_ABS_CHANNEL_VALUE / 2, MAX_ABS_CHANNEL_VALUE / 2
        ) @ plan.basis.astype(np.float64)
    if OPACITIES in logits:
        field_logits = field_opacity_logits(model) if field_logits is None else field_logits
        numbers, error = opacity_error_model(field_logits, arrays[OPACITIES][:, 0], sensitivity.opacities)
        arrays[OPACITIES] = numbers[:, None]
    stop = 0
    for layer, classes in enumerate(layer.points.classes for layer in plan.layers):
        members = slice(stop, stop := stop + len(classes))
        for group in logits:
            is_opacity = group == OPACITIES
            cost = error[members] if is_opacity and error else None
            own_reach = reach and OPACITY_REACH_STEPS if is_opacity else reach
            for column, values in enumerate(arrays[group][members].T):
                jobs[f"{group} {layer} {column}"] = partial(
                    quantize_channel, values, classes, weights[group][members], d, cost, own_reach
                )
        for group in residuals:
            jobs[f"{group} {layer}"] = partial(
                quantize_residuals,
                group,
                arrays[group][members],
                classes,
                residual_sensitivity(sensitivity.subset(members), group, arrays[group].shape[1]),
                d,
                reach,
            )
    quantized = run_jobs(jobs)
    channels = [
        {group: [quantized[f"{group} {layer} {column}"] for column in range(LOGIT_COLUMNS[group])] for group in logits}
        for layer in range(len(plan.layers))
    ]
    layers = range(len(plan.layers)) if residuals else ()
    quantized_residuals = [{group: quantized[f"{group} {layer}"] for group in residuals} for layer in layers]
    groups = {group: quantized[group] for group in plan.groups if group in sections}
    return QuantizedModel(plan, channels, groups, quantized_residuals)


def field_opacity_logits(model: HybridModel) -> np.ndarray:
    """Return what the geometry field adds to the explicit opacity logits of a model, (M,) float64."""
    return opacity_column(model.geometry_outputs())


def opacity_column(geometry_outputs: torch.Tensor) -> np.ndarray:
    """Return `field_opacity_logits` of a model, (M,) float64, from the result (M, 8) of its `geometry_outputs()`."""
    return geometry_outputs[:, 0].double().cpu().numpy()


def opacity_error_model(
    field_logits: np.ndarray, logits: np.ndarray, sensitivity: np.ndarray
) -> tuple[np.ndarray, ErrorModel]:
    """Clamp opacity logits (M,) where the opacity is saturated, and return an error model that works on opacities.

    Args:
        field_logits: (M,) what the geometry field of the planned model adds, see `field_opacity_logits`.
        logits: (M,) explicit opacity logits.
        sensitivity: (M,) sensitivities of the explicit opacity logits.

    Returns:
        (M,) clamped logits; and the model that maps (places, candidate logits) to errors.
    """
    opacities = expit(field_logits + logits)
    weights = sensitivity / np.maximum(opacities * (1 - opacities), 1e-4) ** 2

    error = ErrorModel(opacities, weights, field_logits)
    return np.clip(logits, -SATURATION_LOGIT - field_logits, SATURATION_LOGIT - field_logits), error

"""The error that compressing a single part of a model adds to pictures: predicted, and measured on renders."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass, field
from functools import partial
from typing import Protocol

import numpy as np
import torch

from hyrfpack.compress.plan import distortion_per_number, indices_to_keep
from hyrfpack.compress.planner import PlannedModel, Planner
from hyrfpack.compress.quantize import opacity_column, opacity_error_model, quantize
from hyrfpack.compress.reference_renders import ReferenceRenders
from hyrfpack.compress.residuals import residual_sensitivity
from hyrfpack.compress.sensitivity import PRUNED_KEY, Sensitivity
from hyrfpack.format.arrays import group_shapes, iter_parameters, residual_widths, to_arrays
from hyrfpack.format.compact.quantized import QuantizedModel
from hyrfpack.format.sections import (
    COLORS,
    DECODER_SECTIONS,
    GEOMETRY_TABLE,
    HARMONICS,
    LOGIT_SECTIONS,
    OPACITIES,
    POSITIONS,
    RADIANCE_TABLE,
    RESIDUAL_SECTIONS,
    SCALES,
    SECTION_CONTENTS,
    SHAPES,
    TABLE_SECTIONS,
)
from hyrfpack.model import Decoded, Geometry, HybridModel
from hyrfpack.parallel.pool import return_freed_memory, run_jobs
from hyrfpack.progress import Progress, TaskEvent

# The sections that are quantised and compared together. A decoder has so few numbers that its error depends on chance,
# so it is calibrated together with its table.
Part = tuple[str, ...]
QUANTIZED_PARTS: tuple[Part, ...] = (
    (POSITIONS,),
    (COLORS,),
    (SCALES, OPACITIES),
    (SHAPES,),
    (HARMONICS,),
    *zip(TABLE_SECTIONS, DECODER_SECTIONS, strict=True),
)


# The sections that the colours of Gaussians depend on, apart from positions.
COLOR_SECTIONS = frozenset((COLORS, HARMONICS, RADIANCE_TABLE))


@dataclass(frozen=True)
class ErrorMeasurement:
    """The mean squared error that a part adds to pictures: measured on renders, and predicted by sensitivities."""

    measured: float
    predicted: float


class PartErrors(Protocol):
    """Predicts and measures the errors of some parts of a model."""

    @property
    def parts(self) -> tuple[Part, ...]:
        """The parts, in the order of measurement."""

    def measure(self, sensitivity: Sensitivity, parts: list[Part], progress: Progress) -> dict[Part, ErrorMeasurement]:
        """Compress each of `parts` alone, as `sensitivity` asks for, and return its errors.

        Args:
            sensitivity: sensitivities of all Gaussians of the model.
            parts: some of the parts of this object.
            progress: called with `TaskEvent`s.
        """
        ...


@dataclass(frozen=True)
class PruningErrors:
    """Errors of pruning alone.

    Attributes:
        model: the model to compress.
        geometry: the geometry of its Gaussians.
        references: renders of the model.
        distortion: as in `make_plan`.
    """

    model: HybridModel
    geometry: Geometry
    references: ReferenceRenders
    distortion: float
    parts: tuple[Part, ...] = ((PRUNED_KEY,),)

    def measure(self, sensitivity: Sensitivity, parts: list[Part], progress: Progress) -> dict[Part, ErrorMeasurement]:
        """Measure the error of pruning, see `PartErrors.measure`."""
        progress(TaskEvent("calibrating the prediction of pruning errors", 0.0))
        kept = indices_to_keep(sensitivity, distortion_per_number(self.model, self.distortion))
        predicted = float(np.delete(sensitivity.removals, kept).sum())
        index = torch.as_tensor(kept, device=self.geometry.opacities.device)
        # The colours are known, so the shading is not needed.
        decoded = Decoded(self.geometry[index], shading=None)
        pruned, colors = self.model.subset(index), self.references.colors_of(kept)
        measured = self.references.measure_error(pruned, decoded, colors, predicted)
        return {part: ErrorMeasurement(measured, predicted) for part in parts}


@dataclass
class QuantizationErrors:
    """Errors of quantising the Gaussians and fields that are left after pruning.

    Attributes:
        parts: the parts that the model has.
        planner: plans of the model to compress, before pruning.
        pruned: the model after pruning.
        geometry: the geometry of its Gaussians.
        geometry_outputs: (M, 8) the result of `pruned.geometry_outputs()`.
        references: renders of the pruned model.
        distortion: as in `make_plan`.
    """

    planner: Planner
    pruned: HybridModel
    geometry: Geometry
    geometry_outputs: torch.Tensor
    references: ReferenceRenders
    distortion: float
    parts: tuple[Part, ...] = field(init=False)

    def __post_init__(self) -> None:
        groups = set(group_shapes(self.pruned.config, 0))
        self.parts = tuple(part for part in QUANTIZED_PARTS if groups.issuperset(part))

    def measure(self, sensitivity: Sensitivity, parts: list[Part], progress: Progress) -> dict[Part, ErrorMeasurement]:
        """Quantise all of `parts` and measure the error of each one alone, see `PartErrors.measure`."""
        planned = self.planner.plan(sensitivity, self.distortion)
        field_logits = opacity_column(planned.geometry_outputs)
        names = [name for part in parts for name in part]
        quantized = quantize(planned.model, planned.plan, sensitivity, sections=names, field_logits=field_logits)
        by_section = _predict_quantization_errors(planned.model, quantized, sensitivity, field_logits)
        arrays = _undo_plan_order(quantized)
        del quantized  # Its symbols take memory, and only their values are rendered.
        return_freed_memory()
        errors = {}
        for number, part in enumerate(parts):
            contents = " and ".join(SECTION_CONTENTS[name] for name in part)
            progress(TaskEvent(f"calibrating predicted errors of {contents}", number / len(parts)))
            predicted = sum(by_section[name] for name in part)
            measured = self._measure_part(part, planned, arrays, predicted)
            errors[part] = ErrorMeasurement(measured, predicted)
        return errors

    def _measure_part(
        self,
        part: Part,
        planned: PlannedModel,
        arrays: dict[str, np.ndarray],
        predicted: float,
    ) -> float:
        """Measure the error of the pruned model with the quantised numbers `arrays` of one part, or on the lattice."""
        if part == (POSITIONS,):
            decoded = planned.model.add_shading(planned.model.geometry_from_outputs(planned.geometry_outputs))
            return self.references.measure_error(planned.model, decoded, predicted=predicted)
        changed = _replace_arrays(self.pruned, {name: arrays[name] for name in part})
        if part == (COLORS,) and self.pruned.gaussians.color_residuals is None:
            change = changed.gaussians.color_logits - self.pruned.gaussians.color_logits
            shifted = self.references.shift_color_logits(change)
            return self.references.measure_error(changed, Decoded(self.geometry, shading=None), shifted, predicted)
        colors = None if COLOR_SECTIONS.intersection(part) else self.references.colors
        decoded = decode_changed(changed, part, self.geometry, self.geometry_outputs)
        return self.references.measure_error(changed, decoded, colors, predicted)


def predict_errors(
    planned: HybridModel, quantized: QuantizedModel, sensitivity: Sensitivity, field_logits: np.ndarray
) -> dict[str, float]:
    """Predict the mean squared error that compression adds to pictures, for each section and for PRUNED_KEY.

    Args:
        planned: the planned model.
        quantized: the result of `quantize`.
        sensitivity: the sensitivities of the model before pruning.
        field_logits: the result of `field_opacity_logits(planned)`.
    """
    removed = float(np.delete(sensitivity.removals, quantized.plan.kept).sum())
    return {PRUNED_KEY: removed, **_predict_quantization_errors(planned, quantized, sensitivity, field_logits)}


def _predict_quantization_errors(
    planned: HybridModel, quantized: QuantizedModel, sensitivity: Sensitivity, field_logits: np.ndarray
) -> dict[str, float]:
    """Predict the mean squared error that each quantised section and the positions add to pictures."""
    plan = quantized.plan
    wanted, stored, s = to_arrays(planned), quantized.arrays(), sensitivity.subset(plan.kept)
    weights = {COLORS: np.repeat(s.colors, 3), SCALES: s.scales, **s.fields}
    for group, columns in residual_widths(planned.config).items():
        weights[group] = residual_sensitivity(s, group, columns).ravel()
    # Positions are uniform within their lattice cell: variance 1/12 of the squared step for each of the three axes.
    bits = np.concatenate([layer.points.bits[layer.points.classes] for layer in plan.layers])
    position_error = float((s.positions * 3 / 12 * 4.0**-bits).sum())

    def predict_error(group: str) -> float:
        if group == OPACITIES:
            _, error = opacity_error_model(field_logits, wanted[group][:, 0].astype(np.float64), s.opacities)
            return float(error(slice(None), stored[group][:, 0]).sum())
        difference = stored[group].ravel().astype(np.float64) - wanted[group].ravel()
        return float((weights[group] * difference**2).sum())

    return {POSITIONS: position_error, **run_jobs({group: partial(predict_error, group) for group in stored})}


def _undo_plan_order(quantized: QuantizedModel) -> dict[str, np.ndarray]:
    """Return the quantised numbers by section, with Gaussians in the order of the pruned model.

    So the decoded values of that model can be used for the parts that did not change.
    """
    kept, arrays = quantized.plan.kept, quantized.arrays()

    def undo(name: str) -> np.ndarray:
        values = arrays[name]
        return values[order] if name in (*LOGIT_SECTIONS, *RESIDUAL_SECTIONS) else values

    order = np.argsort(kept)
    return run_jobs({name: partial(undo, name) for name in arrays})


def _replace_arrays(model: HybridModel, arrays: dict[str, np.ndarray]) -> HybridModel:
    """Return a copy of a model in which some sections have the numbers of `arrays` (by section)."""
    changed = deepcopy(model)
    changed.load_state_dict(dict(iter_parameters(arrays, changed)), strict=False)
    return changed


def decode_changed(model: HybridModel, part: Part, geometry: Geometry, geometry_outputs: torch.Tensor) -> Decoded:
    """Decode a model after one part changed, without evaluating again what does not depend on this part.

    Args:
        model: the model after the change.
        part: the part. Unless it is in COLOR_SECTIONS, the result has no shading, because the colours are known.
        geometry: the geometry of the Gaussians before the change.
        geometry_outputs: (N, 8) the result of `geometry_outputs()` before the change.
    """
    if COLOR_SECTIONS.intersection(part):
        return model.add_shading(geometry)
    if GEOMETRY_TABLE in part:
        return Decoded(model.geometry_from_outputs(model.geometry_outputs()), shading=None)
    return Decoded(model.geometry_from_outputs(geometry_outputs), shading=None)

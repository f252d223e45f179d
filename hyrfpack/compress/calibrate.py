"""Calibration of sensitivities: correct each part's predicted error by the error measured on rendered pictures.

A sensitivity is a derivative, so it predicts the error only for small, independent perturbations. Compression breaks
this assumption in three ways:

- Gaussians that move swap their depth order, which adds an error in proportion to the step and not to its square.
- Pruning only removes light, so its errors have the same sign and add up.
- Where opacity or transmittance saturates, a larger perturbation adds no further error.

So each part of a plan is quantised alone, rendered and compared with the model. The part's sensitivities are
multiplied by measured over predicted error, repeatedly, until the prediction is close enough.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from hyrfpack.cameras.view_sampling import sample_views
from hyrfpack.compress.plan import distortion_per_number, indices_to_keep, make_plan
from hyrfpack.compress.quantize import opacity_error_model, quantize
from hyrfpack.compress.sensitivity import PRUNED, Sensitivity, measure_sensitivity
from hyrfpack.format.arrays import iter_parameters, to_arrays
from hyrfpack.format.compact.plan import Plan
from hyrfpack.format.compact.quantized import QuantizedModel
from hyrfpack.format.sections import (
    COLORS,
    DECODER_SECTIONS,
    GEOMETRY_TABLE,
    LOGIT_SECTIONS,
    OPACITIES,
    POSITIONS,
    RADIANCE_TABLE,
    SCALES,
    SECTION_CONTENTS,
    TABLE_SECTIONS,
)
from hyrfpack.model import Decoded, HybridModel
from hyrfpack.parallel.pool import parallel_map
from hyrfpack.progress import Report, no_report, report_part, report_round
from hyrfpack.render import render_view
from hyrfpack.scene import Camera

# The number of views of one comparison is chosen so that about this many Gaussians are drawn in all of them together.
TARGET_DRAWN_GAUSSIANS = 1_000_000
# Half of the views are at cameras and half between them.
MIN_COMPARISON_VIEWS = 6
MAX_COMPARISON_VIEWS = 10
MAX_CORRECTION_ROUNDS = 5
PREDICTION_TOLERANCE_RATIO = 1.2
# Parts whose error is a smaller share of the distortion are not corrected.
MIN_CORRECTED_ERROR_RATIO = 0.03
MAX_CORRECTION_RATIO = 64.0
# The sections that are quantised and compared together. A decoder has so few numbers that its error depends on chance,
# so it is calibrated together with its table.
Part = tuple[str, ...]
CALIBRATED_PARTS: tuple[Part, ...] = (
    (POSITIONS,),
    (COLORS,),
    (SCALES, OPACITIES),
    *zip(TABLE_SECTIONS, DECODER_SECTIONS, strict=True),
)
# A correction multiplies the sensitivities by (measured error / predicted error)^exponent. The exponent is 1 if the
# error falls with the square of the step, as for small independent perturbations. It is up to 2 if the error falls with
# the step, as for swapped depth orders. It is down to 1/2 for pruning, whose errors add up.
CORRECTION_EXPONENTS: dict[Part, float] = {(POSITIONS,): 1.5, (PRUNED,): 0.7}
# An exponent estimated from two factors is used only within these bounds: factors close to each other give noise.
MIN_CORRECTION_EXPONENT = 0.25
MAX_CORRECTION_EXPONENT = 3.0


@dataclass
class CorrectionFactor:
    """Iterative search for the factor that a part's sensitivities are multiplied by.

    Attributes:
        exponent: power of measured over predicted error to multiply by; re-estimated once two factors were measured.
        value: the factor to measure next.
        low, high: the largest factor measured to be too small, and the smallest measured to be large enough.
        converged: whether predicted and measured error agree within PREDICTION_TOLERANCE_RATIO.
        last: the factor measured last, and its ratio of measured to predicted error; None before the first.
    """

    exponent: float
    value: float = 1.0
    low: float = 0.0
    high: float = np.inf
    converged: bool = False
    last: tuple[float, float] | None = None

    def update(self, ratio: float) -> None:
        """Choose the next factor, given the ratio of measured to predicted error with the present `value`."""
        if self.last is not None and ratio > 0:  # The exponent follows by the secant method on logarithms.
            value, before = self.last
            estimate = np.log(self.value / value) / (np.log(before / ratio) or np.inf)
            self.exponent = (
                float(estimate) if MIN_CORRECTION_EXPONENT < estimate < MAX_CORRECTION_EXPONENT else self.exponent
            )
        self.last = (self.value, ratio) if ratio > 0 else None
        if ratio > 1:
            self.low = max(self.low, self.value)
        else:
            self.high = min(self.high, self.value)
        if 1 / PREDICTION_TOLERANCE_RATIO < ratio < PREDICTION_TOLERANCE_RATIO:
            self.converged = True
        elif self.high < PREDICTION_TOLERANCE_RATIO * self.low:
            self.value, self.converged = self.high, True
        else:
            corrected = self.value * min(max(ratio, 1 / MAX_CORRECTION_RATIO), MAX_CORRECTION_RATIO) ** self.exponent
            self.value = corrected if self.low < corrected < self.high else (self.low * self.high) ** 0.5

    @property
    def final(self) -> float:
        """Return the factor to use, which is one that was measured to be large enough, if there is one."""
        return self.value if self.converged or self.high == np.inf else self.high


@dataclass(frozen=True)
class ErrorMeasurement:
    """The mean squared error that a part adds to pictures: measured on renders, and predicted by sensitivities."""

    measured: float
    predicted: float


@dataclass(frozen=True)
class ReferenceRenders:
    """Renders of a model before compression, against which compressed versions are compared.

    Attributes:
        views: the cameras that were rendered.
        pictures: the render of each view, (H, W, 3) in [0, 1].
    """

    views: list[Camera]
    pictures: list[Tensor]

    @classmethod
    def from_model(cls, model: HybridModel, cameras: Sequence[Camera], seed: int = 1) -> ReferenceRenders:
        """Render a model, half of the views at some of its cameras and half between them."""
        count = (
            int(np.clip(TARGET_DRAWN_GAUSSIANS // max(len(model), 1), MIN_COMPARISON_VIEWS, MAX_COMPARISON_VIEWS)) // 2
        )
        at, between = sample_views(cameras, count, seed)
        return cls.from_views([*at, *between], model)

    @classmethod
    def from_views(cls, views: list[Camera], model: HybridModel, decoded: Decoded | None = None) -> ReferenceRenders:
        """Render a model at the given views; `decoded` is as in `measure_error`."""
        return cls(views, _render_views(model, views, decoded))

    def measure_error(self, model: HybridModel, decoded: Decoded | None = None) -> float:
        """Render a model at the same views and return the median over views of the mean squared colour difference.

        The median ignores single views in which a Gaussian comes very close to the camera.

        Args:
            model: the model to compare with the references.
            decoded: the result of `model.decode()`, if it is known already.
        """
        pairs = zip(_render_views(model, self.views, decoded), self.pictures, strict=True)
        return float(np.median([float((shown - reference).square().mean()) for shown, reference in pairs]))


def measure_calibrated_sensitivity(
    model: HybridModel,
    cameras: Sequence[Camera],
    distortion: float,
    prune: bool = True,
    report: Report = no_report,
) -> tuple[Sensitivity, ReferenceRenders]:
    """Measure a model's sensitivities, calibrate them for a distortion, and return them with the reference renders.

    Args:
        cameras: viewpoints typical of how the model will be viewed; world units.
        distortion, prune: as `make_plan` takes them.
        report: called with the name of the current task and the completed share of the work, 0 to 1.

    Raises:
        HyrfError: a number of the model is NaN or infinite.
    """
    sensitivity = measure_sensitivity(model, cameras, report=report_part(report, 0.0, 0.5))
    report("rendering reference views", 0.5)
    references = ReferenceRenders.from_model(model, cameras)
    return calibrate(model, sensitivity, references, distortion, prune, report_part(report, 0.55, 1.0)), references


def calibrate(
    model: HybridModel,
    sensitivity: Sensitivity,
    references: ReferenceRenders,
    distortion: float,
    prune: bool = True,
    report: Report = no_report,
) -> Sensitivity:
    """Scale sensitivities so that they predict the error measured on renders, for plans of about this distortion.

    Args:
        sensitivity: first-order sensitivities from `measure_sensitivity`.
        references: renders of the model.
        distortion, prune: as `make_plan` takes them.
        report: called with the name of the current task and the completed share of the work, 0 to 1.

    Raises:
        HyrfError: a parameter is NaN or infinite.
    """
    per_number, decoded_all = distortion_per_number(model, distortion), model.decode()

    def subset_of(kept: np.ndarray) -> tuple[HybridModel, Decoded]:
        index = torch.as_tensor(kept, device=model.gaussians.positions.device)
        return model.subset(index), decoded_all[index]

    # Pruning is calibrated first, because the errors of the other parts depend on which Gaussians are left.
    def measure_pruning(scaled: Sensitivity, _: list[Part], report: Report) -> dict[Part, ErrorMeasurement]:
        report("calibrating the prediction of pruning errors", 0.0)
        kept = indices_to_keep(scaled, per_number)
        predicted = float(np.delete(scaled.removals, kept).sum())
        return {(PRUNED,): ErrorMeasurement(references.measure_error(*subset_of(kept)), predicted)}

    if prune:
        sensitivity = _correct_by_measurement(
            sensitivity, ((PRUNED,),), distortion, measure_pruning, report_part(report, 0.0, 0.2)
        )
    pruned_model, decoded = subset_of(indices_to_keep(sensitivity, per_number, prune))
    pruned_references = ReferenceRenders.from_views(references.views, pruned_model, decoded)
    last_planned: tuple[np.ndarray, Plan, HybridModel] | None = None

    def measure_quantization(scaled: Sensitivity, parts: list[Part], report: Report) -> dict[Part, ErrorMeasurement]:
        nonlocal last_planned
        if last_planned is None or not np.array_equal(last_planned[0], scaled.positions):
            plan = make_plan(model, scaled, distortion, prune)
            last_planned = scaled.positions, plan, plan.apply(model)
        _, plan, planned = last_planned
        quantized = quantize(planned, plan, scaled, sections=[name for part in parts for name in part])
        predicted, stored = _predict_quantization_errors(planned, quantized, scaled), quantized.arrays()
        # Sorting restores the order of the remaining Gaussians, whose decoded values are reused for unchanged parts.
        order = np.argsort(plan.kept)
        stored = {name: values[order] if name in LOGIT_SECTIONS else values for name, values in stored.items()}

        def measured_error(part: Part) -> float:
            if part == (POSITIONS,):
                return pruned_references.measure_error(planned)
            changed = _replace_arrays(pruned_model, {name: stored[name] for name in part})
            return pruned_references.measure_error(changed, _update_decoded(changed, decoded, part))

        measurements = {}
        for number, part in enumerate(parts):
            report(
                f"calibrating predicted errors of {' and '.join(SECTION_CONTENTS[name] for name in part)}",
                number / len(parts),
            )
            measurements[part] = ErrorMeasurement(measured_error(part), sum(predicted[name] for name in part))
        return measurements

    return _correct_by_measurement(
        sensitivity, CALIBRATED_PARTS, distortion, measure_quantization, report_part(report, 0.2, 1.0)
    )


def predict_errors(
    model: HybridModel, planned: HybridModel, quantized: QuantizedModel, sensitivity: Sensitivity
) -> dict[str, float]:
    """Predict the mean squared error that compression adds to pictures, for each section and for PRUNED."""
    removed = np.delete(sensitivity.removals, quantized.plan.kept)
    return {PRUNED: float(removed.sum()), **_predict_quantization_errors(planned, quantized, sensitivity)}


def _predict_quantization_errors(
    planned: HybridModel, quantized: QuantizedModel, sensitivity: Sensitivity
) -> dict[str, float]:
    """Predict the mean squared error that each quantised section and the positions add to pictures."""
    plan = quantized.plan
    wanted, stored, s = to_arrays(planned), quantized.arrays(), sensitivity.subset(plan.kept)
    weights = {COLORS: np.repeat(s.colors, 3), SCALES: s.scales, **s.fields}
    # Positions are uniform within their lattice cell: variance 1/12 of the squared step for each of the three axes.
    bits = np.concatenate([layer.points.bits[layer.points.classes] for layer in plan.layers])
    errors = {POSITIONS: float((s.positions * 3 / 12 * 4.0**-bits).sum())}
    for group, values in stored.items():
        if group == OPACITIES:
            _, error = opacity_error_model(planned, wanted[group][:, 0].astype(np.float64), s.opacities)
            errors[group] = float(error(slice(None), values[:, 0]).sum())
        else:
            difference = values.ravel().astype(np.float64) - wanted[group].ravel()
            errors[group] = float((weights[group] * difference**2).sum())
    return errors


def _correct_by_measurement(
    sensitivity: Sensitivity,
    parts: Sequence[Part],
    distortion: float,
    measure: Callable[[Sensitivity, list[Part], Report], dict[Part, ErrorMeasurement]],
    report: Report,
) -> Sensitivity:
    """Multiply the sensitivities of each part by a factor, so that predicted errors match measured ones.

    Args:
        measure: measures and predicts the errors of the given parts with the given sensitivities.
    """

    def scaled(factors: dict[Part, float]) -> Sensitivity:
        return sensitivity.scaled_by({name: factor for part, factor in factors.items() for name in part})

    factors = {part: CorrectionFactor(CORRECTION_EXPONENTS.get(part, 1.0)) for part in parts}
    for number in range(MAX_CORRECTION_ROUNDS):
        remaining = [part for part, factor in factors.items() if not factor.converged]
        if not remaining:
            break
        values = scaled({part: factor.value for part, factor in factors.items()})
        for part, error in measure(values, remaining, report_round(report, number)).items():
            if error.predicted > 0 and max(error.measured, error.predicted) > MIN_CORRECTED_ERROR_RATIO * distortion:
                factors[part].update(error.measured / error.predicted)
            else:
                factors[part].converged = True
    return scaled({part: factor.final for part, factor in factors.items()})


def _replace_arrays(model: HybridModel, arrays: dict[str, np.ndarray]) -> HybridModel:
    """Return a copy of a model in which some sections have the numbers of `arrays` (by section)."""
    changed = deepcopy(model)
    changed.load_state_dict(dict(iter_parameters(arrays, changed)), strict=False)
    return changed


def _update_decoded(model: HybridModel, before: Decoded, part: Part) -> Decoded:
    """Decode a model again after one part changed, reusing the results `before` that do not depend on this part."""
    if GEOMETRY_TABLE in part or OPACITIES in part:
        return replace(before, geometry=model.decode_geometry())
    if before.shading is None:
        return before
    if RADIANCE_TABLE in part:
        return replace(before, shading=model.shading())
    return replace(before, shading=replace(before.shading, color_logits=model.gaussians.color_logits.detach()))


@torch.no_grad()
def _render_views(model: HybridModel, cameras: Sequence[Camera], decoded: Decoded | None = None) -> list[Tensor]:
    decoded = decoded or model.decode()

    @torch.no_grad()  # gradient mode is kept per thread
    def picture(camera: Camera) -> Tensor:
        return render_view(model, camera, decoded=decoded).rgb

    return parallel_map(picture, cameras, model.gaussians.positions.device)

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

from collections.abc import Sequence
from dataclasses import replace

import torch

from hyrfpack.compress.correction import SensitivityCorrection
from hyrfpack.compress.part_errors import PartErrors, PruningErrors, QuantizationErrors
from hyrfpack.compress.plan import distortion_per_number, indices_to_keep
from hyrfpack.compress.planner import Planner
from hyrfpack.compress.reference_renders import ReferenceRenders
from hyrfpack.compress.sensitivity import TARGET_DRAWN_GAUSSIANS, Sensitivity, measure_sensitivity
from hyrfpack.model import Decoded, HybridModel
from hyrfpack.parallel.pool import return_freed_memory, torch_on_one_thread
from hyrfpack.progress import Progress, TaskEvent, ignore_progress, part_of_progress, round_of_progress
from hyrfpack.scene import Camera

MAX_CORRECTION_ROUNDS = 3
# Parts whose error is a smaller share of the distortion are not corrected.
MIN_CORRECTED_ERROR_RATIO = 0.03


def measure_calibrated_sensitivity(
    model: HybridModel,
    cameras: Sequence[Camera],
    distortion: float,
    prune: bool = True,
    progress: Progress = ignore_progress,
    drawn: int = TARGET_DRAWN_GAUSSIANS,
    planner: Planner | None = None,
) -> tuple[Sensitivity, ReferenceRenders]:
    """Measure a model's sensitivities, calibrate them for a distortion, and return them with the reference renders.

    Args:
        cameras: viewpoints typical of how the model will be viewed; world units.
        distortion, prune: as `make_plan` takes them.
        progress: called with `TaskEvent`s.
        drawn: as `measure_sensitivity` takes it.
        planner: plans of the model, if they are used afterwards.

    Raises:
        HyrfError: a number of the model is NaN or infinite.
    """
    progress(TaskEvent("rendering reference views", 0.0))
    outputs = model.geometry_outputs()
    geometry = model.geometry_from_outputs(outputs)
    references = ReferenceRenders.from_model(model, cameras, model.add_shading(geometry))
    measuring, calibrating = part_of_progress(progress, 0.05, 0.55), part_of_progress(progress, 0.55, 1.0)
    # The sensitivities are not kept in a variable, so that their memory is free once they are scaled.
    calibrated = calibrate(
        model,
        measure_sensitivity(model, cameras, progress=measuring, drawn=drawn, geometry=geometry),
        references,
        distortion,
        prune,
        calibrating,
        planner,
        outputs,
    )
    return calibrated, replace(references, colors=[])  # Colours take memory, and only calibration uses them.


@torch_on_one_thread()
@torch.no_grad()
def calibrate(
    model: HybridModel,
    sensitivity: Sensitivity,
    references: ReferenceRenders,
    distortion: float,
    prune: bool = True,
    progress: Progress = ignore_progress,
    planner: Planner | None = None,
    outputs: torch.Tensor | None = None,
) -> Sensitivity:
    """Scale sensitivities so that they predict the error measured on renders, for plans of about this distortion.

    Args:
        sensitivity: first-order sensitivities from `measure_sensitivity`. If no view shows a Gaussian, they stay.
        references: renders of the model.
        distortion, prune: as `make_plan` takes them.
        progress: called with `TaskEvent`s.
        planner: as `measure_calibrated_sensitivity` takes it.
        outputs: (N, 8) the result of `model.geometry_outputs()`, if it is known.

    Raises:
        HyrfError: a parameter is NaN or infinite.
    """
    if not sensitivity.is_seen:
        return sensitivity
    return_freed_memory()
    outputs = model.geometry_outputs() if outputs is None else outputs
    geometry = model.geometry_from_outputs(outputs)
    # Pruning is calibrated first, because the errors of the other parts depend on which Gaussians are left.
    if prune:
        errors = PruningErrors(model, geometry, references, distortion)
        sensitivity = _match_measurements(sensitivity, errors, distortion, part_of_progress(progress, 0.0, 0.2))
        del errors  # It refers to the geometry of all Gaussians, whose memory is free once they are pruned.
    kept = indices_to_keep(sensitivity, distortion_per_number(model, distortion), prune)
    index = torch.as_tensor(kept, device=outputs.device)
    pruned, outputs, geometry = model.subset(index), outputs[index], geometry[index]
    decoded, colors = Decoded(geometry, shading=None), references.colors_of(kept)
    references = ReferenceRenders.from_views(references.views, pruned, decoded, colors)
    quantization = QuantizationErrors(
        planner or Planner(model, prune), pruned, geometry, outputs, references, distortion
    )
    return _match_measurements(sensitivity, quantization, distortion, part_of_progress(progress, 0.2, 1.0))


def _match_measurements(
    sensitivity: Sensitivity, errors: PartErrors, distortion: float, progress: Progress
) -> Sensitivity:
    """Multiply the sensitivities of each part by a factor, so that its predicted error matches the measured one."""
    correction = SensitivityCorrection(sensitivity, errors.parts)
    for number in range(MAX_CORRECTION_ROUNDS):
        if not correction.remaining:
            break
        measured = errors.measure(correction.candidate(), correction.remaining, round_of_progress(progress, number))
        correction.update(measured, min_error=MIN_CORRECTED_ERROR_RATIO * distortion)
    return correction.result()

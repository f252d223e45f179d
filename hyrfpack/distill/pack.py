"""Compress a distilled model to the smallest file that reaches a target PSNR."""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
from scipy.optimize import brentq

from hyrfpack.cameras.paths import Viewpoint
from hyrfpack.compress.calibrate import calibrate, measure_calibrated_sensitivity
from hyrfpack.compress.field_codes import quantize_fields
from hyrfpack.compress.packer import Packer
from hyrfpack.compress.reference_renders import ReferenceRenders
from hyrfpack.compress.sensitivity import measure_sensitivity
from hyrfpack.distill.distillation import DistilledModel
from hyrfpack.distill.residuals import exact_model
from hyrfpack.progress import (
    Progress,
    TaskEvent,
    ignore_progress,
    part_of_progress,
    round_of_progress,
)

_LOG = logging.getLogger(__name__)

# Compression is planned for this share of the error that it may add, because the measured error varies.
PLANNED_ERROR_SHARE = 0.8
# If the model's own error leaves too little of the allowed error, compression may still add the smaller of two errors:
# this share of the model's error, and this share of the allowed error.
FALLBACK_MODEL_ERROR_SHARE = 0.25
FALLBACK_ALLOWED_ERROR_SHARE = 0.5
MAX_TRIALS = 5
# With residuals, fields are quantised as if they alone might add this error, in dB; residuals correct it.
FIELD_PSNR = 28.0


def pack(
    distilled: DistilledModel,
    psnr: float,
    provenance: dict,
    progress: Progress = ignore_progress,
) -> bytes:
    """Encode the smallest file that reaches a target PSNR on the validation views.

    Args:
        distilled: the model, and reference renders of the original.
        psnr: target PSNR in dB against the reference renders.
        provenance: provenance to store in the file; the viewpoint is added to it.
        progress: called with `TaskEvent`s.

    Returns:
        The bytes of the file.

    Example:
        >>> from hyrfpack.distill import DistillConfig
        >>> from hyrfpack.distill.distillation import distill_model
        >>> from hyrfpack.splats.files import read_splats
        >>> quick = DistillConfig(steps=1, size=16, train_views=2, test_views=2)
        >>> distilled = distill_model(read_splats("bonsai.ply"), quick)
        >>> pack(distilled, psnr=15, provenance={})[:4]
        b'HYRF'
    """
    model = distilled.model
    psnrs = np.array(distilled.validation.psnr_per_view(model))
    allowed, error = _mse(psnr), _mse(psnrs.mean())
    allowance = max(allowed - error, min(FALLBACK_MODEL_ERROR_SHARE * error, FALLBACK_ALLOWED_ERROR_SHARE * allowed))
    _LOG.info(f"measuring how each stored number affects renders, at {len(distilled.train)} cameras and between them")
    distortion = PLANNED_ERROR_SHARE * solve_added_error(_mse(psnrs), error + allowance)
    measuring, field_codes = part_of_progress(progress, 0.0, 0.7), None
    if distilled.exact is None:
        sensitivity, references = measure_calibrated_sensitivity(model, distilled.train, distortion, progress=measuring)
    else:
        sensitivity = measure_sensitivity(model, distilled.train, progress=part_of_progress(measuring, 0.0, 0.5))
        model, field_codes = quantize_fields(model, sensitivity, _mse(FIELD_PSNR))
        model = exact_model(model, distilled.exact)
        references = ReferenceRenders.from_model(model, distilled.train)
        rest = part_of_progress(measuring, 0.55, 1.0)
        sensitivity = calibrate(model, sensitivity, references, distortion, progress=rest, field_codes=field_codes)
    provenance = {**provenance, "viewpoint": Viewpoint.from_cameras(distilled.train).to_json()}
    encoding = part_of_progress(progress, 0.7, 0.85)
    packer = Packer(model, provenance, sensitivity, progress=encoding, field_codes=field_codes)
    candidate = packer.encode_to_distortion(distortion, references)
    for number in range(MAX_TRIALS):
        trial_progress = round_of_progress(part_of_progress(progress, 0.85, 1.0), number)
        trial_progress(TaskEvent("comparing renders of the file with those of the original", 0.0))
        added_error = _mse(np.mean(distilled.validation.psnr_per_view(packer.decode(candidate)))) - error
        if added_error <= allowance:
            break
        distortion *= max(PLANNED_ERROR_SHARE * allowance / added_error, 1 / 16)
        _LOG.info(
            f"packing adds a mean squared error of {added_error:.2g}, limit {allowance:.2g}; encoding again at "
            f"distortion {distortion:.2g}"
        )
        candidate = packer.encode(distortion, part_of_progress(trial_progress, 0.5, 1.0))
    return candidate.data


def solve_added_error(errors: np.ndarray, mean: float) -> float:
    """Solve for the error that, added to the error of each view, brings their geometric mean to `mean`.

    The geometric mean of the errors is the error of the mean PSNR. The solution is smaller than the difference of
    `mean` and the current geometric mean, because the PSNR of the best views drops most.

    Args:
        errors: (n,) mean squared error of each view.
        mean: geometric mean to reach.

    Example:
        >>> round(solve_added_error(np.array([1.0, 100.0]), 20.0), 2)
        2.89
    """

    def excess(added: float) -> float:
        return float(np.log(errors + added).mean() - np.log(mean))

    least = 1e-6 * mean
    return least if excess(least) >= 0 else float(brentq(excess, least, mean, xtol=1e-3 * least))


def _mse(psnr: Any) -> Any:
    """Convert PSNRs in dB to mean squared errors of colours in [0, 1]."""
    return 10 ** (-psnr / 10)

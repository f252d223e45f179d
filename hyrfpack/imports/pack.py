"""Compress a model of splats to the smallest file that reaches a target PSNR."""

from __future__ import annotations

import logging
from collections.abc import Callable

import numpy as np
from scipy.optimize import brentq

from hyrfpack.cameras.paths import Viewpoint
from hyrfpack.compress.calibrate import measure_calibrated_sensitivity
from hyrfpack.compress.limits import EncodedCandidate
from hyrfpack.compress.packer import Packer
from hyrfpack.counts import format_count
from hyrfpack.errors import HyrfSizeError
from hyrfpack.imports.prepare import PreparedModel
from hyrfpack.measure.psnr import mse_from_psnr
from hyrfpack.progress import Progress, TaskEvent, ignore_progress, part_of_progress, round_of_progress

_LOG = logging.getLogger(__name__)

# Compression is planned for this share of the error that it may add, because the measured error varies.
PLANNED_ERROR_SHARE = 0.8
# If the model's own error leaves too little of the allowed error, compression may still add the smaller of two errors:
# this share of the model's error, and this share of the allowed error.
FALLBACK_MODEL_ERROR_SHARE = 0.25
FALLBACK_ALLOWED_ERROR_SHARE = 0.5
# The search ends with a file whose error is at least this share of the allowed one, and aims at the second share.
ACCEPTED_ERROR_RATIO = 0.85
AIMED_ERROR_RATIO = 0.93
MIN_ERROR_RATIO = 1e-3  # Smaller ratios, also negative ones, are noise.
# Smallest d log error ratio / d log distortion; it is below 1 if a few views have most of the error.
MIN_LOG_SLOPE = 0.4
MAX_LOG_STEP = np.log(16)
MAX_TRIALS = 6
# Views around splats differ in distance by a factor of four, so more of them are measured than of a capture.
DRAWN_GAUSSIANS = 15_000_000


def pack(
    prepared: PreparedModel,
    psnr: float,
    provenance: dict,
    progress: Progress = ignore_progress,
    *,
    worst: float | None = None,
    target_bytes: int | None = None,
) -> bytes:
    """Encode the smallest file that reaches target PSNRs on the validation views, or the best one within a size.

    Args:
        prepared: the model, and reference renders of the original.
        psnr: target PSNR in dB against the reference renders, mean over views.
        provenance: provenance to store in the file; the viewpoint is added to it.
        progress: called with `TaskEvent`s.
        worst: target PSNR in dB of the worst view, if any.
        target_bytes: size to fill in place of reaching a PSNR.

    Returns:
        The bytes of the file.

    Raises:
        HyrfSizeError: no file is as small as `target_bytes`.

    Example:
        >>> from hyrfpack.imports import ImportConfig
        >>> from hyrfpack.imports.prepare import prepare_model
        >>> from hyrfpack.splats.files import read_splats
        >>> quick = ImportConfig(size=16, views=2, test_views=2)
        >>> prepared = prepare_model(read_splats("bonsai.ply"), quick)
        >>> pack(prepared, psnr=15, provenance={})[:4]
        b'HYRF'
    """
    model = prepared.model
    psnrs = np.array(prepared.validation.psnr_per_view(model))
    allowed, error = mse_from_psnr(psnr), mse_from_psnr(psnrs.mean())
    allowance = max(allowed - error, min(FALLBACK_MODEL_ERROR_SHARE * error, FALLBACK_ALLOWED_ERROR_SHARE * allowed))
    _LOG.info(
        f"measuring how each stored number affects renders, at {format_count(len(prepared.cameras), 'camera')} and "
        "between them"
    )
    distortion = PLANNED_ERROR_SHARE * solve_added_error(mse_from_psnr(psnrs), error + allowance)
    measuring = part_of_progress(progress, 0.0, 0.7)
    sensitivity, _ = measure_calibrated_sensitivity(
        model, prepared.cameras, distortion, progress=measuring, drawn=DRAWN_GAUSSIANS
    )
    provenance = {**provenance, "viewpoint": Viewpoint.from_cameras(prepared.cameras).to_json()}
    packer = Packer(model, provenance, sensitivity)
    if target_bytes is not None:
        packer.progress = part_of_progress(progress, 0.7, 1.0)
        try:
            return packer.encode_within_bytes(target_bytes, distortion)[0].data
        except HyrfSizeError as cause:
            raise HyrfSizeError(
                cause.problem,
                fix=f"use a `target_bytes` of at least {cause.min_bytes:,}",
                min_bytes=cause.min_bytes,
            ) from cause

    def error_ratio(candidate: EncodedCandidate) -> float:
        """Return the larger ratio of an error to its limit: that of the mean, or that of the worst view."""
        scores = prepared.validation.psnr_per_view(packer.decode(candidate))
        ratio = (mse_from_psnr(np.mean(scores)) - error) / allowance
        return ratio if worst is None else max(ratio, mse_from_psnr(min(scores)) / mse_from_psnr(worst))

    return _search(packer, distortion, error_ratio, part_of_progress(progress, 0.7, 1.0)).data


def _search(
    packer: Packer, distortion: float, error_ratio: Callable[[EncodedCandidate], float], progress: Progress
) -> EncodedCandidate:
    """Search for the smallest file whose error ratio is at most 1; without one, return that of the smallest error.

    The next distortion is found by interpolation of the logarithms of the last two error ratios.

    Args:
        packer: encodes the files.
        distortion: of the first file.
        error_ratio: measures a file.
        progress: called with `TaskEvent`s.
    """
    trials: list[tuple[float, float, EncodedCandidate]] = []
    for number in range(MAX_TRIALS):
        trial_progress = round_of_progress(progress, number)
        candidate = packer.encode(distortion, part_of_progress(trial_progress, 0.0, 0.5))
        trial_progress(TaskEvent("comparing renders of the file with those of the original", 0.5))
        ratio = max(error_ratio(candidate), MIN_ERROR_RATIO)
        _LOG.info(f"distortion {distortion:.2g}: {len(candidate.data):,} bytes, {ratio:.2f} of the allowed error")
        trials.append((distortion, ratio, candidate))
        if ACCEPTED_ERROR_RATIO <= ratio <= 1:
            break
        distortion = _next_distortion([(d, r) for d, r, _ in trials[-2:]])
    fitting = [candidate for _, ratio, candidate in trials if ratio <= 1]
    return min(fitting, key=lambda one: len(one.data)) if fitting else min(trials, key=lambda trial: trial[1])[2]


def _next_distortion(measured: list[tuple[float, float]]) -> float:
    """Return the distortion at which the error ratio is expected to be AIMED_ERROR_RATIO.

    Args:
        measured: one or two pairs of a distortion and its error ratio, the last one last.
    """
    (first, first_ratio), (last, last_ratio) = (np.log(pair) for pair in (measured[0], measured[-1]))
    slope = (last_ratio - first_ratio) / (last - first) if last != first else 1.0
    step = (np.log(AIMED_ERROR_RATIO) - last_ratio) / min(max(slope, MIN_LOG_SLOPE), 1 / MIN_LOG_SLOPE)
    return float(np.exp(last + np.clip(step, -MAX_LOG_STEP, MAX_LOG_STEP)))


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

"""Choice of the degree of spherical harmonics for a scene; with few cameras a higher degree can overfit."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from hyrfpack.cameras.view_sampling import shrink_camera
from hyrfpack.export.bake_parts import PartsVisibility, bake_parts
from hyrfpack.export.measure import measure_psnr
from hyrfpack.export.source import MAX_MEASURED_VIEWS, MIN_CAMERAS_TO_HOLD_OUT
from hyrfpack.model import HybridModel
from hyrfpack.model.merged import MergedModel
from hyrfpack.progress import Progress, ignore_progress, part_of_progress
from hyrfpack.scene import Camera, evenly_spaced

# Every ninth camera, from the fifth on, is a validation camera. Generated cameras stand at three heights
# in turn, of which this slice takes the middle one.
VALIDATION_CAMERAS = slice(4, None, 9)
MAX_GAUSSIANS = 200_000
# A lower degree takes fewer bytes, so it may score this much less than the best one.
SCORE_TOLERANCE_DB = 0.2


def choose_degree(
    model: HybridModel | MergedModel,
    cameras: Sequence[Camera],
    highest: int,
    visibility: PartsVisibility | None = None,
    progress: Progress = ignore_progress,
) -> tuple[int, dict[int, float]]:
    """Choose the lowest degree of harmonics, 0 to `highest`, whose score is within SCORE_TOLERANCE_DB of the best.

    The model is baked at all degrees without the validation cameras. A degree's score is the PSNR of its pictures at
    the validation cameras (at most 512 pixels a side, without the background) against the model's. With fewer than
    MIN_CAMERAS_TO_HOLD_OUT cameras, all are fitted and all are compared, so overfitting is not detected. In models with
    more than MAX_GAUSSIANS Gaussians, every n-th is used.

    Args:
        model: a model on the CPU.
        cameras: cameras at which colours may be fitted, world units, without those that will measure the result.
        highest: highest degree to consider, 0 to 3.
        visibility: result of `compute_parts_visibility` for the cameras, if it is known already.
        progress: called with `TaskEvent`s.

    Returns:
        The degree, and the score in dB of each degree.
    """
    fit_cameras, validation = list(cameras), list(cameras)
    stride = -(-len(model) // MAX_GAUSSIANS)
    if stride > 1:
        model, visibility = model.subset(torch.arange(0, len(model), stride)), None
    fit_visibility = None if visibility is None else [list(views) for views in visibility]
    if len(cameras) >= MIN_CAMERAS_TO_HOLD_OUT:
        validation = fit_cameras[VALIDATION_CAMERAS]
        del fit_cameras[VALIDATION_CAMERAS]
        for views_of_part in fit_visibility or []:
            del views_of_part[VALIDATION_CAMERAS]
    baked = bake_parts(model, fit_cameras, range(highest + 1), fit_visibility, part_of_progress(progress, 0.0, 0.6))
    candidates = {str(degree): (splats, None) for degree, splats in baked.items()}
    views = [(shrink_camera(camera), None) for camera in evenly_spaced(validation, MAX_MEASURED_VIEWS)]
    measured = measure_psnr(model, candidates, views, sphere=False, progress=part_of_progress(progress, 0.6, 1.0))
    scores = {degree: measured[str(degree)].model for degree in baked}
    return choose_lowest_degree(scores), scores


def choose_lowest_degree(scores: dict[int, float]) -> int:
    """Return the lowest degree whose score in dB is within SCORE_TOLERANCE_DB of the best."""
    return min(degree for degree, score in scores.items() if score >= max(scores.values()) - SCORE_TOLERANCE_DB)

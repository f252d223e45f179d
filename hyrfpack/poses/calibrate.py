"""Estimate a camera's focal length from matched photos, and detect whether the camera only rotated between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap

from hyrfpack.poses.alignment import nearest_rotation
from hyrfpack.poses.job import DEFAULT_FOCAL_RATIO
from hyrfpack.progress import Progress, TaskEvent, ignore_progress

FOCAL_SEARCH_TASK = "estimating focal lengths from matches"

# Focal lengths over the longer side of the picture, from the wide angles of phones to short telephoto lenses.
CANDIDATE_FOCAL_RATIOS = np.geomspace(0.45, 2.8, 17)
# The score of a focal length, a ratio of matches, is lowered by penalty * (ln(focal / default) / width)^2.
_PRIOR_PENALTY = 0.01
_PRIOR_LOG_WIDTH = 0.5
_RANSAC_ERROR_PIXELS = 1.0  # a looser threshold would accept any focal length
_MAX_RANSAC_TRIALS = 150
_ROTATION_INLIER_PIXELS = 3.0  # a rotation explains a match if its error is below this
_ROTATION_ONLY_INLIER_RATIO = 0.85  # a pair with this ratio of matches explained by a rotation has no translation


@dataclass(frozen=True, eq=False)
class PixelMatches:
    """Matches between two photos of one camera, in pixels.

    Attributes:
        pixels1: (M, 2) pixel coordinates in the first photo.
        pixels2: (M, 2) pixel coordinates in the second photo.
    """

    pixels1: np.ndarray
    pixels2: np.ndarray


def search_focal_ratio(
    pairs: Sequence[PixelMatches],
    camera: pycolmap.Camera,
    seed: int,
    progress: Progress = ignore_progress,
    task: str = FOCAL_SEARCH_TASK,
) -> float:
    """Search the focal length, over the longer side, with which calibrated geometry explains the most matches.

    The score of a candidate is the mean inlier ratio minus a small penalty for its distance from DEFAULT_FOCAL_RATIO.
    The penalty decides between candidates that matches do not distinguish, as with flat ground from above or motion
    straight ahead.

    Args:
        pairs: matches between photos of the camera.
        camera: the camera, of which only size and model are used.
        seed: random seed of RANSAC.
        progress: called with a `TaskEvent` before each candidate.
        task: description of these events.
    """
    options = pycolmap.RANSACOptions()
    options.max_error, options.random_seed = _RANSAC_ERROR_PIXELS, seed % 2**31
    options.min_num_trials, options.max_num_trials = _MAX_RANSAC_TRIALS // 3, _MAX_RANSAC_TRIALS
    scores = []
    for index, focal in enumerate(CANDIDATE_FOCAL_RATIOS):
        progress(TaskEvent(task, index / len(CANDIDATE_FOCAL_RATIOS)))
        candidate = camera_with_focal(camera, focal)
        inlier_ratios = []
        for pair in pairs:
            fit = pycolmap.estimate_essential_matrix(pair.pixels1, pair.pixels2, candidate, candidate, options)
            inlier_ratios.append(0.0 if fit is None else fit["num_inliers"] / len(pair.pixels1))
        scores.append(
            np.mean(inlier_ratios) - _PRIOR_PENALTY * (np.log(focal / DEFAULT_FOCAL_RATIO) / _PRIOR_LOG_WIDTH) ** 2
        )
    return float(CANDIDATE_FOCAL_RATIOS[int(np.argmax(scores))])


def camera_with_focal(camera: pycolmap.Camera, focal: float) -> pycolmap.Camera:
    """Return a copy of a camera without distortion, whose focal length is `focal` times the longer side."""
    width, height = camera.width, camera.height
    model = camera.model_name
    return pycolmap.Camera.create_from_model_name(camera.camera_id, model, focal * max(width, height), width, height)


def rotation_only_share(pairs: Sequence[PixelMatches], camera: pycolmap.Camera, focal_ratios: Sequence[float]) -> float:
    """Return the share of pairs between which the camera only rotated, at the focal length where it is largest.

    Args:
        pairs: matches between photos of one camera.
        camera: the camera, of which only the size is used.
        focal_ratios: possible focal lengths, over the longer side.
    """
    longer_side, centre = max(camera.width, camera.height), np.array([camera.width, camera.height]) / 2
    shares = []
    for focal in focal_ratios:
        is_rotation_only = [
            _rotation_inlier_share(p, centre, focal * longer_side) >= _ROTATION_ONLY_INLIER_RATIO for p in pairs
        ]
        shares.append(float(np.mean(is_rotation_only)))
    return max(shares, default=0.0)


def _rotation_inlier_share(pair: PixelMatches, centre: np.ndarray, focal: float) -> float:
    """Fit a rotation to the matches of a pair by reweighted least squares; return the share of matches it explains."""
    first, second = (
        np.column_stack([(pixels - centre) / focal, np.ones(len(pixels))]) for pixels in (pair.pixels1, pair.pixels2)
    )
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second /= np.linalg.norm(second, axis=1, keepdims=True)
    weights = np.ones(len(first))
    error = np.zeros(len(first))
    for _ in range(6):
        rotation = nearest_rotation((second * weights[:, None]).T @ first)
        error = np.linalg.norm(first @ rotation.T - second, axis=1) * focal
        weights = 1 / np.maximum(error, 0.5)
    return float(np.mean(error < _ROTATION_INLIER_PIXELS))

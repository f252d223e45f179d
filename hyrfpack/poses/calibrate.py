"""What pairs of photos say of the camera: its focal length where EXIF does not, and whether it ever moved."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap

from hyrfpack.poses.job import GUESS

FOCALS = np.geomspace(0.45, 2.8, 17)  # that are tried, in longer sides: wide angles of phones to short telephotos
_PRIOR = 0.01, 0.5  # how much of the matches an e-fold off from the guess must explain more: (share, in e-folds) ^ 2
_CLOSE = 1.0  # pixels: the error of a match that fits; tight, for loose ones fit any focal length
_TRIALS = 150  # of RANSAC for each pair and focal length
_TURN_ERROR = 3.0  # pixels: how far off a match may be that a camera which only turned explains
_PANORAMA = 0.85  # share of a pair's matches from which on it only turned


@dataclass(frozen=True, eq=False)
class Pair:
    """Matched pixels of two photos of one camera.

    Attributes:
        pixels1, pixels2: (M, 2).
    """

    pixels1: np.ndarray
    pixels2: np.ndarray


def search_focal(
    pairs: Sequence[Pair], camera: pycolmap.Camera, seed: int, progress: Callable[[float], None] = lambda share: None
) -> float:
    """The focal length with which calibrated geometry explains most matches, in longer sides of the picture.

    Where pairs do not tell (flat ground from above, motion straight ahead) it is near the guess.

    Args:
        pairs: of the camera's own photos.
        camera: its size and model; its focal length does not matter.
        seed: of RANSAC.
        progress: called with the share of the search that is done.
    """
    options = pycolmap.RANSACOptions()
    options.max_error, options.random_seed = _CLOSE, seed % 2**31
    options.min_num_trials, options.max_num_trials = _TRIALS // 3, _TRIALS
    scores = []
    for place, focal in enumerate(FOCALS):
        progress(place / len(FOCALS))
        tried = with_focal(camera, focal)
        found = [pycolmap.estimate_essential_matrix(p.pixels1, p.pixels2, tried, tried, options) for p in pairs]
        shares = [0.0 if f is None else f["num_inliers"] / len(p.pixels1) for f, p in zip(found, pairs, strict=True)]
        scores.append(np.mean(shares) - _PRIOR[0] * (np.log(focal / GUESS) / _PRIOR[1]) ** 2)
    return float(FOCALS[int(np.argmax(scores))])


def with_focal(camera: pycolmap.Camera, focal: float) -> pycolmap.Camera:
    """A copy of a camera without distortion, with a focal length in longer sides."""
    width, height = camera.width, camera.height
    model = camera.model_name
    return pycolmap.Camera.create_from_model_name(camera.camera_id, model, focal * max(width, height), width, height)


def turned_only(pairs: Sequence[Pair], camera: pycolmap.Camera, focals: Sequence[float]) -> float:
    """The share of pairs between which the camera turned and did not move, at the focal length where it is largest.

    Args:
        pairs: of one camera's photos.
        camera: its size.
        focals: that are possible, in longer sides.
    """
    longer, centre = max(camera.width, camera.height), np.array([camera.width, camera.height]) / 2
    shares = []
    for focal in focals:
        turned = [_turn_explains(p, centre, focal * longer) >= _PANORAMA for p in pairs]
        shares.append(float(np.mean(turned)))
    return max(shares, default=0.0)


def _turn_explains(pair: Pair, centre: np.ndarray, focal: float) -> float:
    """The share of a pair's matches that a rotation explains: least squares, reweighted to be robust."""
    first, second = (
        np.column_stack([(pixels - centre) / focal, np.ones(len(pixels))]) for pixels in (pair.pixels1, pair.pixels2)
    )
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second /= np.linalg.norm(second, axis=1, keepdims=True)
    weights = np.ones(len(first))
    error = np.zeros(len(first))
    for _ in range(6):
        left, _, right = np.linalg.svd((second * weights[:, None]).T @ first)
        rotation = left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right
        error = np.linalg.norm(first @ rotation.T - second, axis=1) * focal
        weights = 1 / np.maximum(error, 0.5)
    return float(np.mean(error < _TURN_ERROR))

"""Fit the exposure map of a model to the per-image gains that were learnt beside it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from hyrfpack.model.exposure import (
    MAX_CENTERS,
    MAX_DIRECTION_CODE,
    MAX_LOG_GAIN,
    MAX_POSITION_CODE,
    MAX_WEIGHT_CODE,
    ExposureMap,
    inverse_quadratic_kernel,
)

# These lengths of the kernel and ridges are tried. A radius is the root mean square distance of the cameras from their
# mean. A ridge is the variance of noise relative to that of the gains.
POSITION_LENGTHS_RADII = (0.25, 0.5, 1.0, 2.0, 4.0)
DIRECTION_LENGTHS_DEGREES = (15.0, 30.0, 60.0, 120.0)
RIDGE_VARIANCES = (0.01, 0.03, 0.1, 0.3, 1.0, 3.0)
# If the radius is a smaller multiple of the cameras' distance from the origin, or of 1, they are in one place up to
# rounding, and the exposure depends on the direction alone.
MIN_RADIUS_RATIO = 1e-6
# A map is rejected if the bound of a log gain's change per degree of viewing angle, or per radius, is larger.
MAX_SLOPE_PER_DEGREE = 0.15
MAX_SLOPE_PER_RADIUS = 20.0
# A centre is left out if its variance, given the centres before it, is a smaller multiple of the ridge.
MIN_CENTER_VARIANCE_RIDGES = 0.1


@dataclass(frozen=True)
class ExposureFit:
    """An exposure map and its error on photos that it was not fitted to.

    Attributes:
        map: the exposure map.
        leave_one_out_error: root mean square error of each photo's log gains predicted from all other photos; 0 if
            there is only one photo.
    """

    map: ExposureMap
    leave_one_out_error: float


def fit_exposure_map(poses: Sequence[np.ndarray], log_gains: np.ndarray) -> ExposureFit:
    """Fit log gains over viewpoints by kernel ridge regression.

        minimise  sum_n |y_n - mean - sum_m k(v_n, v_m) w_m|^2 + ridge w^T K w

    The centres v_m are a subset of the cameras, chosen by pivoted Cholesky factorisation of the kernel matrix. Each
    further centre is the camera that the centres so far predict worst, until the remaining variance is small. The
    kernel's lengths and the ridge are those with the smallest leave-one-out error.

    Args:
        poses: N >= 1 poses (4, 4), camera_from_local, of the training photos.
        log_gains: (N, 3) finite log gains of these photos.
    """
    gains = np.clip(np.asarray(log_gains, np.float64), -MAX_LOG_GAIN, MAX_LOG_GAIN)
    matrices = np.asarray(poses, np.float64)
    positions = -np.einsum("nji,nj->ni", matrices[:, :3, :3], matrices[:, :3, 3])
    directions = matrices[:, 2, :3]
    radius = float(np.sqrt(np.square(positions - positions.mean(0)).sum(1).mean()))
    if radius <= MIN_RADIUS_RATIO * max(1.0, float(np.abs(positions).max())):
        radius = 1.0
    candidates = []
    for length, angle in product(POSITION_LENGTHS_RADII, DIRECTION_LENGTHS_DEGREES):
        lengths = np.array([length * radius, 2 * np.sin(np.radians(angle) / 2)], np.float32)
        features = np.concatenate((positions / lengths[0], directions / lengths[1]), 1)
        centers, factor, variances = choose_centers(features)
        for ridge in RIDGE_VARIANCES:
            # Variances are in descending order, so the centres to keep come first.
            count = int((variances >= MIN_CENTER_VARIANCE_RIDGES * ridge).sum())
            error = leave_one_out_error(factor[:, :count], gains, ridge)
            candidates.append((error, lengths, centers[:count], ridge))
    for error, lengths, centers, ridge in sorted(candidates, key=lambda candidate: candidate[0]):
        fitted = _solve(
            _without_weights(positions, directions, gains, lengths, centers), positions, directions, gains, ridge
        )
        per_unit, per_radian = fitted.slope_bounds
        if radius * per_unit <= MAX_SLOPE_PER_RADIUS and np.radians(per_radian) <= MAX_SLOPE_PER_DEGREE:
            return ExposureFit(fitted, error)
    spread = float(np.sqrt(np.square(gains - gains.mean(0)).mean()))
    return ExposureFit(_without_weights(positions, directions, gains, lengths, []), spread)


def _without_weights(
    positions: np.ndarray, directions: np.ndarray, gains: np.ndarray, lengths: np.ndarray, centers: list[int]
) -> ExposureMap:
    """Return a map that has the mean exposure everywhere, because the weights of its centres are 0."""
    box = np.stack((positions.min(0), positions.max(0))).astype(np.float32)
    box[0] = np.nextafter(box[0], -np.inf, dtype=np.float32)  # so that rounding leaves no camera outside
    box[1] = np.nextafter(box[1], np.inf, dtype=np.float32)
    size = np.maximum(box[1].astype(np.float64) - box[0], 1e-30)
    return ExposureMap(
        box=box,
        lengths=lengths,
        mean=gains.mean(0).astype(np.float32),
        limits=np.stack((gains.min(0), gains.max(0))).astype(np.float32),
        steps=np.ones(3, np.float32),
        positions=np.rint((positions[centers] - box[0]) / size * MAX_POSITION_CODE).clip(0, 255).astype(np.uint8),
        directions=np.rint(directions[centers] * MAX_DIRECTION_CODE).astype(np.int8),
        weights=np.zeros((len(centers), 3), np.int16),
    )


def choose_centers(features: np.ndarray) -> tuple[list[int], np.ndarray, np.ndarray]:
    """Choose centres by pivoted Cholesky factorisation of the kernel matrix.

    Args:
        features: (N, D) features of the cameras, see `hyrfpack.model.exposure.inverse_quadratic_kernel`.

    Returns:
        The rows of the M <= 64 centres in the order in which they were chosen; F (N, M) with F F^T close to the kernel
        matrix; and (M,) the variance of each centre given those before it, in descending order.
    """
    residual = np.ones(len(features))
    factor = np.zeros((len(features), 0))
    centers: list[int] = []
    variances: list[float] = []
    while len(centers) < min(MAX_CENTERS, len(features)):
        row = int(residual.argmax())
        if residual[row] < MIN_CENTER_VARIANCE_RIDGES * RIDGE_VARIANCES[0]:
            break
        column = (inverse_quadratic_kernel(features, features[row : row + 1])[:, 0] - factor @ factor[row]) / np.sqrt(
            residual[row]
        )
        factor = np.column_stack((factor, column))
        centers.append(row)
        variances.append(residual[row])
        residual = residual - column**2
    return centers, factor, np.array(variances)


def leave_one_out_error(factor: np.ndarray, gains: np.ndarray, ridge: float) -> float:
    """Return the root mean square error of each photo's log gains predicted from those of all others.

    If row n is left out, a linear smoother with matrix H has the residual (y - H y)_n / (1 - H_nn) there.
    """
    if len(gains) < 2:
        return 0.0
    design = np.column_stack((np.ones(len(gains)), factor))
    penalty = np.diag([0.0] + [ridge] * factor.shape[1])
    solver = np.linalg.solve(design.T @ design + penalty, design.T)
    one_minus_leverages = np.maximum(1 - np.einsum("nm,mn->n", design, solver), 1e-9)
    return float(np.sqrt(np.square((gains - design @ (solver @ gains)) / one_minus_leverages[:, None]).mean()))


def _solve(
    exposure: ExposureMap, positions: np.ndarray, directions: np.ndarray, gains: np.ndarray, ridge: float
) -> ExposureMap:
    """Return the map with the mean and weights that minimise the penalised error, given its centres as stored."""
    camera_kernel = exposure.evaluate_kernel(positions, directions)
    center_kernel = exposure.evaluate_center_kernel()
    count = len(center_kernel)
    design = np.column_stack((np.ones(len(gains)), camera_kernel))
    penalty = np.zeros((count + 1, count + 1))
    penalty[1:, 1:] = ridge * center_kernel
    # Rounding may have made two centres equal. Least squares then takes the smallest of several solutions.
    solution = np.linalg.lstsq(design.T @ design + penalty, design.T @ gains, rcond=1e-10)[0]
    mean, weights = solution[0], solution[1:]
    steps = np.full(3, 1.0, np.float32)
    if count:
        steps = np.maximum(np.abs(weights).max(0) / MAX_WEIGHT_CODE, 1e-12).astype(np.float32)
    codes = np.rint(weights / steps).clip(-MAX_WEIGHT_CODE, MAX_WEIGHT_CODE).astype(np.int16)
    return replace(exposure, mean=mean.astype(np.float32), steps=steps, weights=codes)

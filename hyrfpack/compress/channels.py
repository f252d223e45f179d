"""Quantise channels of one number per Gaussian and one step per class, each number predicted from those before it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from hyrfpack.compress.rate_distortion import (
    LAMBDA_PER_DISTORTION,
    choose_step_codes,
    choose_symbols,
    estimate_code_bits,
    look_up_bits,
)
from hyrfpack.format.compact.channels import MAX_ABS_CHANNEL_VALUE, Channel
from hyrfpack.quant.lifting import lift
from hyrfpack.quant.steps import FIXED_POINT_ONE, decode_step

# Candidate weights of the prediction.
PREDICTION_WEIGHTS_SIXTEENTHS = (0, 6, 9, 12)
# This is the code of step 8e-6, with which any two numbers of a channel differ by less than 2^30 steps.
MIN_STEP_CODE = 32
# At most this many numbers of a channel are used to choose the weight.
_WEIGHT_SAMPLE_SIZE = 1 << 16

# Maps (places, candidate values) to the mean squared error that each candidate would add to pictures.
ErrorModel = Callable[[Any, np.ndarray], np.ndarray]


def quantize_channel(
    values: np.ndarray,
    classes: np.ndarray,
    sensitivity: np.ndarray,
    distortion: float,
    error: ErrorModel | None = None,
    reach: int = 1,
) -> Channel:
    """Choose the step of each class and the symbol of each number of a channel.

    Args:
        values: (N,) float64; clamped to +-MAX_ABS_CHANNEL_VALUE.
        classes: (N,) uint8 class of each number.
        sensitivity: (N,) sensitivity s of each number, above 0.
        distortion: D, the error that each number may add, see `hyrfpack.compress.rate_distortion`.
        error: error of candidate values; by default s (candidate - value)^2.
        reach: distance in steps of the furthest candidate from the nearest symbol; 0 takes the nearest and ignores
            the rate.
    """
    codes = choose_channel_codes(classes, sensitivity, distortion)
    steps = decode_step(codes)[classes]
    values = np.clip(values, -MAX_ABS_CHANNEL_VALUE, MAX_ABS_CHANNEL_VALUE)
    mean = np.float32(np.average(values, weights=1 / steps)) if len(values) else np.float32(0)
    target = np.rint((values - float(mean)) * FIXED_POINT_ONE).astype(np.int64)
    weight = _choose_weight(target, steps)

    nearest = _nearest_chooser(target, steps)
    residuals, decoded = lift(len(target), weight, steps, nearest)
    if reach:
        bits = estimate_code_bits(residuals, classes, len(codes), reach)

        def added_error(places: np.ndarray, candidates: np.ndarray) -> np.ndarray:
            if error is not None:
                return error(places, candidates)
            return sensitivity[places] * (candidates - values[places]) ** 2

        def choose(places: np.ndarray, prediction: np.ndarray) -> np.ndarray:
            step = steps[places]

            def cost(symbols: np.ndarray) -> np.ndarray:
                return added_error(places, (prediction + symbols * step) / FIXED_POINT_ONE + float(mean))

            return choose_symbols(nearest(places, prediction), cost, classes[places], bits, distortion, reach)

        def total(symbols: np.ndarray, numbers: np.ndarray) -> float:
            errors = added_error(np.arange(len(numbers)), numbers / FIXED_POINT_ONE + float(mean))
            return float(errors.sum() + LAMBDA_PER_DISTORTION * distortion * look_up_bits(symbols, classes, bits).sum())

        # A choice also changes the predictions of later numbers. With coarse steps this can cost more than it saves.
        chosen = lift(len(target), weight, steps, choose)
        if total(*chosen) < total(residuals, decoded):
            residuals, decoded = chosen
    return Channel(mean, weight, codes, residuals, decoded / FIXED_POINT_ONE + float(mean))


def choose_channel_codes(classes: np.ndarray, sensitivity: np.ndarray, distortion: float) -> np.ndarray:
    """Choose the step code (K,) uint8 of each class of a channel; arguments are those of `quantize_channel`."""
    members = np.bincount(classes, minlength=int(classes.max(initial=0)) + 1)
    mean = np.bincount(classes, sensitivity, len(members)) / np.maximum(members, 1)
    return np.maximum(choose_step_codes(np.where(members > 0, mean, 1), distortion), MIN_STEP_CODE)


def requantize_channel(
    values: np.ndarray, classes: np.ndarray, codes: np.ndarray, mean: np.float32, weight: int | None = None
) -> Channel:
    """Quantise a channel with given steps: each number takes the nearest symbol.

    Args:
        values: (N,) float64, clamped to +-MAX_ABS_CHANNEL_VALUE.
        classes: (N,) uint8 class of each number.
        codes: (K,) uint8 step code of each class, at least MIN_STEP_CODE.
        mean: number that is added to all.
        weight: weight of the prediction in sixteenths; None for the best of PREDICTION_WEIGHTS_SIXTEENTHS. With weight
            0, numbers of the form mean + n step are kept exactly.
    """
    steps = decode_step(codes)[classes]
    values = np.clip(values, -MAX_ABS_CHANNEL_VALUE, MAX_ABS_CHANNEL_VALUE)
    target = np.rint((values - float(mean)) * FIXED_POINT_ONE).astype(np.int64)
    weight = _choose_weight(target, steps) if weight is None else weight
    residuals, decoded = lift(len(target), weight, steps, _nearest_chooser(target, steps))
    return Channel(mean, weight, codes, residuals, decoded / FIXED_POINT_ONE + float(mean))


def _choose_weight(target: np.ndarray, steps: np.ndarray) -> int:
    """Choose the weight with the lowest estimated rate on a contiguous run of the numbers."""
    start = max(len(target) - _WEIGHT_SAMPLE_SIZE, 0) // 2
    target, steps = target[start : start + _WEIGHT_SAMPLE_SIZE], steps[start : start + _WEIGHT_SAMPLE_SIZE]
    nearest = _nearest_chooser(target, steps)

    def cost(weight: int) -> float:
        return float(np.log2(np.abs(lift(len(target), weight, steps, nearest)[0]) + 0.5).sum())

    return min(PREDICTION_WEIGHTS_SIXTEENTHS, key=cost)


def _nearest_chooser(target: np.ndarray, steps: np.ndarray) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """Return the choice function for `lift` that rounds each residual to the step nearest to the target (N,) int64."""

    def nearest(places: np.ndarray, prediction: np.ndarray) -> np.ndarray:
        step = steps[places]
        return (target[places] - prediction + (step >> 1)) // step

    return nearest

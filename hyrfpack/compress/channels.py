"""The steps and symbols of a channel: one number for each Gaussian, a step for each class, predicted along the list."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from hyrfpack.compress.rate_distortion import ERROR_PER_BIT, best_steps, bits_of, cheapest, code_bits
from hyrfpack.format.compact.channels import MAX_ABS_CHANNEL_VALUE, Channel
from hyrfpack.quant.lifting import lift
from hyrfpack.quant.steps import ONE, step_of

WEIGHTS = (0, 6, 9, 12)  # of the prediction, in sixteenths, that are tried
FINEST = 32  # step code, 8e-6: with it differences of numbers within the limit stay below 2^30 steps
_SAMPLE = 1 << 16  # numbers that the weight is chosen on

# (places, candidate values) -> what each would add to the pictures' mean squared error
ErrorModel = Callable[[Any, np.ndarray], np.ndarray]


def quantize_channel(
    values: np.ndarray,
    classes: np.ndarray,
    sensitivity: np.ndarray,
    distortion: float,
    error: ErrorModel | None = None,
    reach: int = 1,
    weight: int | None = None,
) -> Channel:
    """Choose the steps and the symbols of a channel.

    Args:
        values: (N,) float64; cut to +-MAX_ABS_CHANNEL_VALUE.
        classes: (N,) uint8.
        sensitivity: (N,) s of each number, above 0.
        distortion: D, what each number may add, see `hyrfpack.compress.rate_distortion`.
        error: what a candidate would cost; by default s (candidate - value)^2.
        reach: how many steps from the nearest are tried; 0 takes the nearest, without counting bits.
        weight: of the prediction; by default the best of WEIGHTS.
    """
    kinds = int(classes.max(initial=0)) + 1
    members = np.bincount(classes, minlength=kinds)
    mean_sensitivity = np.bincount(classes, sensitivity, kinds) / np.maximum(members, 1)
    codes = np.maximum(best_steps(np.where(members > 0, mean_sensitivity, 1), distortion), FINEST)
    steps = step_of(codes)[classes]
    values = np.clip(values, -MAX_ABS_CHANNEL_VALUE, MAX_ABS_CHANNEL_VALUE)
    mean = np.float32(np.average(values, weights=1 / steps)) if len(values) else np.float32(0)
    target = np.rint((values - float(mean)) * ONE).astype(np.int64)
    weight = _best_weight(target, steps) if weight is None else weight

    nearest = _nearest(target, steps)
    residuals, decoded = lift(len(target), weight, steps, nearest)
    if reach:
        bits = code_bits(residuals, classes, kinds, reach)

        def added(places: np.ndarray, candidates: np.ndarray) -> np.ndarray:
            if error is not None:
                return error(places, candidates)
            return sensitivity[places] * (candidates - values[places]) ** 2

        def choose(places: np.ndarray, prediction: np.ndarray) -> np.ndarray:
            step = steps[places]

            def cost(symbols: np.ndarray) -> np.ndarray:
                return added(places, (prediction + symbols * step) / ONE + float(mean))

            return cheapest(nearest(places, prediction), cost, classes[places], bits, distortion, reach)

        def total(symbols: np.ndarray, numbers: np.ndarray) -> float:
            errors = added(np.arange(len(numbers)), numbers / ONE + float(mean))
            return float(errors.sum() + ERROR_PER_BIT * distortion * bits_of(symbols, classes, bits).sum())

        # A number left at its prediction is what others are predicted by: with coarse steps that can cost more.
        chosen = lift(len(target), weight, steps, choose)
        if total(*chosen) < total(residuals, decoded):
            residuals, decoded = chosen
    return Channel(mean, weight, codes, residuals, decoded / ONE + float(mean))


def _best_weight(target: np.ndarray, steps: np.ndarray) -> int:
    """The weight with the fewest bits, about, on a run of the numbers."""
    start = max(len(target) - _SAMPLE, 0) // 2
    target, steps = target[start : start + _SAMPLE], steps[start : start + _SAMPLE]
    nearest = _nearest(target, steps)

    def cost(weight: int) -> float:
        return float(np.log2(np.abs(lift(len(target), weight, steps, nearest)[0]) + 0.5).sum())

    return min(WEIGHTS, key=cost)


def _nearest(target: np.ndarray, steps: np.ndarray) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """What `lift` shall choose to come nearest to the target (N,) int64."""

    def nearest(places: np.ndarray, prediction: np.ndarray) -> np.ndarray:
        step = steps[places]
        return (target[places] - prediction + (step >> 1)) // step

    return nearest

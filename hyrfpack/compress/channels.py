"""Quantise channels of one number per Gaussian and one step per class, each number predicted from those before it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.special import expit

from hyrfpack.compress.rate_distortion import (
    LAMBDA_PER_DISTORTION,
    choose_step_codes,
    choose_symbols,
    estimate_code_bits,
    look_up_bits,
)
from hyrfpack.format.compact.channels import MAX_ABS_CHANNEL_VALUE, Channel
from hyrfpack.quant.lifting import lift
from hyrfpack.quant.rans import uses_numba
from hyrfpack.quant.steps import FIXED_POINT_ONE, decode_step

# Candidate weights of the prediction.
PREDICTION_WEIGHTS_SIXTEENTHS = (0, 6, 9, 12)
# This is the code of step 8e-6, with which any two numbers of a channel differ by less than 2^30 steps.
MIN_STEP_CODE = 32
# At most this many numbers of a channel are used to choose the weight.
_WEIGHT_SAMPLE_SIZE = 1 << 16


@dataclass(frozen=True)
class ErrorModel:
    """The mean squared error that candidate values of a channel's numbers would add to pictures.

    It is weight (x - target)^2 for a candidate x. For an opacity logit it is weight (sigmoid(field_logit + x) -
    target)^2, which saturates.

    Attributes:
        targets: (N,) float64 numbers, or opacities.
        weights: (N,) float64.
        field_logits: (N,) float64 what the geometry field adds to opacity logits; None if errors do not saturate.
    """

    targets: np.ndarray
    weights: np.ndarray
    field_logits: np.ndarray | None = None

    def __call__(self, places: Any, candidates: np.ndarray) -> np.ndarray:
        """Return the error (n,) of candidates (n,) at places: an index (n,) or a slice."""
        if self.field_logits is not None:
            candidates = expit(self.field_logits[places] + candidates)
        return self.weights[places] * (candidates - self.targets[places]) ** 2

    def __getitem__(self, places: slice) -> ErrorModel:
        field_logits = None if self.field_logits is None else self.field_logits[places]
        return ErrorModel(self.targets[places], self.weights[places], field_logits)


def quantize_channel(
    values: np.ndarray,
    classes: np.ndarray,
    sensitivity: np.ndarray,
    distortion: float,
    error: ErrorModel | None = None,
    reach: int = 1,
    implementation: str = "auto",
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
        implementation: "numpy", "cpu" (Numba) or "auto"; the symbols are the same.
    """
    codes = choose_channel_codes(classes, sensitivity, distortion)
    steps = decode_step(codes)
    values = np.clip(values, -MAX_ABS_CHANNEL_VALUE, MAX_ABS_CHANNEL_VALUE)
    mean = np.float32(np.average(values, weights=(1 / steps)[classes])) if len(values) else np.float32(0)
    fixed = np.rint((values - float(mean)) * FIXED_POINT_ONE).astype(np.int64)
    choices = (_CompiledChoices if uses_numba(implementation) else _Choices)(fixed, classes, steps)
    weight = _choose_weight(choices)
    symbols, decoded = choices.take_nearest(weight)
    if reach:
        bits = estimate_code_bits(symbols, classes, len(codes), reach)
        error = ErrorModel(values, np.asarray(sensitivity, np.float64)) if error is None else error
        cost = _Cost(error, bits, distortion, float(mean))
        # A choice also changes the predictions of later numbers. With coarse steps this can cost more than it saves.
        chosen = choices.take_cheapest(weight, cost, reach)
        if choices.sum_costs(*chosen, cost) < choices.sum_costs(symbols, decoded, cost):
            symbols, decoded = chosen
    return Channel(mean, weight, codes, symbols, decoded / FIXED_POINT_ONE + float(mean))


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
    values = np.clip(values, -MAX_ABS_CHANNEL_VALUE, MAX_ABS_CHANNEL_VALUE)
    fixed = np.rint((values - float(mean)) * FIXED_POINT_ONE).astype(np.int64)
    choices = (_CompiledChoices if uses_numba("auto") else _Choices)(fixed, classes, decode_step(codes))
    weight = _choose_weight(choices) if weight is None else weight
    residuals, decoded = choices.take_nearest(weight)
    return Channel(mean, weight, codes, residuals, decoded / FIXED_POINT_ONE + float(mean))


@dataclass(frozen=True)
class _Cost:
    """The cost of symbols: the error that they add, and their bits times lambda.

    Attributes:
        error: error of numbers.
        bits: table from `estimate_code_bits`.
        distortion: D, the error that each number may add.
        mean: the number that is added to all decoded ones.
    """

    error: ErrorModel
    bits: tuple[np.ndarray, int]
    distortion: float
    mean: float


@dataclass(frozen=True)
class _Choices:
    """Choices of the symbols of a channel, in numpy.

    Attributes:
        fixed: (N,) int64 numbers in fixed point, less the mean of the channel.
        classes: (N,) uint8 class of each number.
        steps: (K,) int64 step of each class.
    """

    fixed: np.ndarray
    classes: np.ndarray
    steps: np.ndarray

    def __getitem__(self, places: slice) -> _Choices:
        return replace(self, fixed=self.fixed[places], classes=self.classes[places])

    def take_nearest(self, weight: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the symbols (N,) nearest to the numbers, and the decoded numbers in fixed point, less the mean."""
        return lift(len(self.fixed), weight, self.steps[self.classes], self._nearest)

    def take_cheapest(self, weight: int, cost: _Cost, reach: int) -> tuple[np.ndarray, np.ndarray]:
        """Return what `take_nearest` does for the symbols of the lowest cost within `reach` of the nearest ones."""

        def choose(places: np.ndarray, prediction: np.ndarray) -> np.ndarray:
            step = self.steps[self.classes[places]]

            def error(symbols: np.ndarray) -> np.ndarray:
                return cost.error(places, (prediction + symbols * step) / FIXED_POINT_ONE + cost.mean)

            nearest = self._nearest(places, prediction)
            return choose_symbols(nearest, error, self.classes[places], cost.bits, cost.distortion, reach)

        return lift(len(self.fixed), weight, self.steps[self.classes], choose)

    def sum_costs(self, symbols: np.ndarray, decoded: np.ndarray, cost: _Cost) -> float:
        """Return the cost of all symbols of the channel together."""
        errors = cost.error(slice(None), decoded / FIXED_POINT_ONE + cost.mean)
        rates = LAMBDA_PER_DISTORTION * cost.distortion * look_up_bits(symbols, self.classes, cost.bits)
        return float(errors.sum() + rates.sum())

    def _nearest(self, places: np.ndarray, prediction: np.ndarray) -> np.ndarray:
        """Return the differences between numbers and their predictions, rounded to steps."""
        step = self.steps[self.classes[places]]
        return (self.fixed[places] - prediction + (step >> 1)) // step


class _CompiledChoices(_Choices):
    """The same choices by Numba."""

    def take_nearest(self, weight: int) -> tuple[np.ndarray, np.ndarray]:
        unused = np.zeros(0)  # Without a reach, no cost is computed.
        return self._lift(weight, 0, 0.0, unused, unused, unused, unused[None], 0)

    def take_cheapest(self, weight: int, cost: _Cost, reach: int) -> tuple[np.ndarray, np.ndarray]:
        return self._lift(weight, reach, cost.mean, *self._cost_arrays(cost))

    def sum_costs(self, symbols: np.ndarray, decoded: np.ndarray, cost: _Cost) -> float:
        from hyrfpack.compress import quantization_kernels

        arrays = self._cost_arrays(cost)
        return quantization_kernels.sum_channel_costs(
            symbols, decoded, self.classes, float(FIXED_POINT_ONE), cost.mean, *arrays
        )

    def _lift(self, weight: int, reach: int, mean: float, *cost_arrays: Any) -> tuple[np.ndarray, np.ndarray]:
        from hyrfpack.compress import quantization_kernels

        symbols, decoded = np.empty((2, len(self.fixed)), np.int64)
        quantization_kernels.lift_channel(
            _lifting_levels(len(self.fixed), weight), weight, self.fixed, self.classes, self.steps, reach,
            float(FIXED_POINT_ONE), mean, *cost_arrays, symbols, decoded,
        )  # fmt: skip
        return symbols, decoded

    @staticmethod
    def _cost_arrays(cost: _Cost) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, int]:
        """Return what `quantization_kernels.lift_channel` takes from `targets` to `lowest`."""
        table, lowest = cost.bits
        error, rates = cost.error, LAMBDA_PER_DISTORTION * cost.distortion * table
        field_logits = np.zeros(0) if error.field_logits is None else error.field_logits
        return error.targets, error.weights, field_logits, rates, lowest


def _lifting_levels(count: int, weight: int) -> np.ndarray:
    """Return the first place, the stride, and the distance to the neighbours of each level of `lift`, (L, 3) int64.

    With weight 0 no number depends on another, so one level has all of them.
    """
    if weight == 0:
        return np.array([(0, 1, 0)])
    distances = [1 << power for power in reversed(range(max(count - 1, 0).bit_length()))]
    return np.array([(0, max(count, 1), 0), *((distance, 2 * distance, distance) for distance in distances)])


def _choose_weight(choices: _Choices) -> int:
    """Choose the weight with the lowest estimated rate on a contiguous run of the numbers."""
    start = max(len(choices.fixed) - _WEIGHT_SAMPLE_SIZE, 0) // 2
    sample = choices[start : start + _WEIGHT_SAMPLE_SIZE]

    def cost(weight: int) -> float:
        return float(np.log2(np.abs(sample.take_nearest(weight)[0]) + 0.5).sum())

    return min(PREDICTION_WEIGHTS_SIXTEENTHS, key=cost)

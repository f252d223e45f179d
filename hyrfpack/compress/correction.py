"""Correction of sensitivities: a factor for each part, found from measured and predicted errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hyrfpack.compress.part_errors import ErrorMeasurement, Part
from hyrfpack.compress.sensitivity import PRUNED_KEY, Sensitivity
from hyrfpack.format.sections import (
    GEOMETRY_DECODER,
    GEOMETRY_TABLE,
    POSITIONS,
    RADIANCE_DECODER,
    RADIANCE_TABLE,
)

# A part that takes 1.4 times its share of the error costs less than 1 % more bits than the best split.
PREDICTION_TOLERANCE_RATIO = 1.4
# Ratios of measured to predicted error that are close enough, where they are lower than 1 / PREDICTION_TOLERANCE_RATIO.
# Positions have steps of powers of two, so their error jumps where a class gets another step, and no factor may give an
# error between the two.
MIN_ERROR_RATIOS: dict[Part, float] = {(POSITIONS,): 0.5}
MAX_CORRECTION_RATIO = 64.0
# If measured and predicted error differ by a smaller ratio than this, the corrected factor is not measured again.
MAX_UNMEASURED_RATIO = 2.0
# Factors to measure first: medians of those found for trained models of twelve captures.
TYPICAL_FACTORS: dict[Part, float] = {
    (POSITIONS,): 1.6,
    (GEOMETRY_TABLE, GEOMETRY_DECODER): 0.8,
    (RADIANCE_TABLE, RADIANCE_DECODER): 0.8,
}
# A correction multiplies the sensitivities by (measured error / predicted error)^exponent. The exponent is 1 if the
# error falls with the square of the step, as for small independent perturbations. It is up to 2 if the error falls with
# the step, as for swapped depth orders. It is down to 1/2 for pruning, whose errors add up. That of the radiance table
# is the median of those that eleven trained models needed, 0.67 to 1.27.
CORRECTION_EXPONENTS: dict[Part, float] = {
    (POSITIONS,): 1.5,
    (RADIANCE_TABLE, RADIANCE_DECODER): 0.8,
    (PRUNED_KEY,): 0.7,
}
# An exponent estimated from two factors is used only within these bounds: factors close to each other give noise.
MIN_CORRECTION_EXPONENT = 0.25
MAX_CORRECTION_EXPONENT = 3.0


@dataclass
class CorrectionFactor:
    """Iterative search for the factor that a part's sensitivities are multiplied by.

    Attributes:
        exponent: power of measured over predicted error to multiply by; re-estimated once two factors were measured.
        value: the best factor known, which is measured next unless it has converged.
        low, high: the largest factor measured to be too small, and the smallest measured to be large enough.
        converged: whether the factor needs no further measurement, because measured over predicted error lies between
            `min_ratio` and PREDICTION_TOLERANCE_RATIO, or was near 1 before the last correction.
        last: the factor measured last, and its ratio of measured to predicted error; None before the first.
        min_ratio: the lowest ratio of measured to predicted error that counts as converged.
    """

    exponent: float
    value: float = 1.0
    low: float = 0.0
    high: float = np.inf
    converged: bool = False
    last: tuple[float, float] | None = None
    min_ratio: float = 1 / PREDICTION_TOLERANCE_RATIO

    def update(self, ratio: float) -> None:
        """Choose the next factor, given the ratio of measured to predicted error at the current `value`."""
        if self.last is not None and ratio > 0:  # The exponent follows by the secant method on logarithms.
            value, before = self.last
            estimate = np.log(self.value / value) / (np.log(before / ratio) or np.inf)
            self.exponent = (
                float(estimate) if MIN_CORRECTION_EXPONENT < estimate < MAX_CORRECTION_EXPONENT else self.exponent
            )
        self.last = (self.value, ratio) if ratio > 0 else None
        if ratio > 1:
            self.low = max(self.low, self.value)
        else:
            self.high = min(self.high, self.value)
        if self.min_ratio < ratio < PREDICTION_TOLERANCE_RATIO:
            self.converged = True
        elif self.high < PREDICTION_TOLERANCE_RATIO * self.low:
            self.value, self.converged = self.high, True
        else:
            corrected = self.value * min(max(ratio, 1 / MAX_CORRECTION_RATIO), MAX_CORRECTION_RATIO) ** self.exponent
            self.value = corrected if self.low < corrected < self.high else (self.low * self.high) ** 0.5
            self.converged = 1 / MAX_UNMEASURED_RATIO < ratio < MAX_UNMEASURED_RATIO


class SensitivityCorrection:
    """Search for the factors by which the sensitivities of several parts are multiplied, one factor for each part."""

    def __init__(self, sensitivity: Sensitivity, parts: Sequence[Part]) -> None:
        """Start from typical factors for `parts`, the groups of sections that share a factor."""
        self._sensitivity = sensitivity
        self._factors = {
            part: CorrectionFactor(
                CORRECTION_EXPONENTS.get(part, 1.0),
                TYPICAL_FACTORS.get(part, 1.0),
                min_ratio=MIN_ERROR_RATIOS.get(part, 1 / PREDICTION_TOLERANCE_RATIO),
            )
            for part in parts
        }

    @property
    def remaining(self) -> list[Part]:
        """Return the parts whose factors have not converged."""
        return [part for part, factor in self._factors.items() if not factor.converged]

    def candidate(self) -> Sensitivity:
        """Return the sensitivities with the factors to measure next."""
        return self._scaled({part: factor.value for part, factor in self._factors.items()})

    def update(self, errors: Mapping[Part, ErrorMeasurement], min_error: float) -> None:
        """Choose the next factors, given the errors that parts have with the current candidate.

        Args:
            errors: errors of the parts that were measured.
            min_error: mean squared error; parts that are predicted and measured below it keep their factor.
        """
        for part, error in errors.items():
            if error.predicted > 0 and max(error.measured, error.predicted) > min_error:
                self._factors[part].update(error.measured / error.predicted)
            else:
                self._factors[part].converged = True

    def result(self) -> Sensitivity:
        """Return the sensitivities with the final factors."""
        return self._scaled({part: factor.value for part, factor in self._factors.items()})

    def _scaled(self, factors: Mapping[Part, float]) -> Sensitivity:
        return self._sensitivity.scaled_by({name: factor for part, factor in factors.items() for name in part})

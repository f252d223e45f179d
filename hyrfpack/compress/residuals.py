"""Quantisation of residuals: which Gaussians keep theirs, and how finely, by rate and distortion."""

from __future__ import annotations

from functools import partial

import numpy as np

from hyrfpack.compress.rate_distortion import (
    LAMBDA_PER_DISTORTION,
    choose_step_codes,
    choose_symbols,
    estimate_code_bits,
    look_up_bits,
)
from hyrfpack.compress.sensitivity import Sensitivity
from hyrfpack.format.compact.groups import iter_blocks
from hyrfpack.format.compact.residuals import ResidualSymbols, residual_bands
from hyrfpack.format.sections import HARMONICS
from hyrfpack.quant.steps import FIXED_POINT_ONE, MAX_ABS_SYMBOL, decode_step

# Statistics of the symbols depend on which Gaussians have residuals, and the other way round.
SELECTION_ROUNDS = 3


def quantize_residuals(
    group: str, values: np.ndarray, classes: np.ndarray, sensitivity: np.ndarray, distortion: float, reach: int = 1
) -> ResidualSymbols:
    """Choose the steps of each class, the Gaussians that keep their residuals, and their symbols.

    A Gaussian keeps its residuals if they lower its error by more than lambda times the bits that they take.

    Args:
        group: section type in the first layer.
        values: (N, columns) float64 residuals; those of colours in the basis that the file has.
        classes: (N,) uint8 class of each Gaussian.
        sensitivity: (N, columns) sensitivity of each number.
        distortion: D, the error that each number may add, see `hyrfpack.compress.rate_distortion`.
        reach: distance in steps of the furthest candidate from the nearest symbol; 0 takes the nearest.
    """
    class_count = int(classes.max(initial=0)) + 1
    members = np.maximum(np.bincount(classes, minlength=class_count), 1)
    price = LAMBDA_PER_DISTORTION * distortion
    zero_error = (sensitivity * values**2).sum(axis=1)
    bands, start = [], 0
    for band in residual_bands(group, values.shape[1]):
        columns = slice(start, start := start + band.width)
        weights = sensitivity[:, columns]
        mean = np.bincount(classes, weights.mean(axis=1), class_count) / members
        codes = choose_step_codes(np.where(mean > 0, mean, 1), distortion)
        steps = (decode_step(codes) / FIXED_POINT_ONE)[classes][:, None]
        limit = MAX_ABS_SYMBOL - reach  # The chosen symbol lies up to `reach` steps beyond the nearest one.
        nearest = np.clip(np.rint(values[:, columns] / steps), -limit, limit).astype(np.int32)
        bands.append((band, weights, values[:, columns], codes, steps, nearest))
    flags = zero_error > price * values.shape[1]
    chosen = [nearest for *_, nearest in bands]
    for _ in range(SELECTION_ROUNDS):
        error, rate, chosen = np.zeros(len(values)), np.zeros(len(values)), []
        for band, weights, wanted, _, steps, nearest in bands:
            contexts, count = band.contexts(classes, class_count), class_count * band.components
            bits = estimate_code_bits(nearest[flags].ravel(), contexts[flags].ravel(), count, reach)
            symbols = np.empty_like(nearest)
            for rows in iter_blocks(len(values)):
                shape, places = nearest[rows].shape, contexts[rows].ravel()
                scale = np.broadcast_to(steps[rows], shape).ravel()
                cost = partial(_added_error, weights[rows].ravel(), wanted[rows].ravel(), scale)
                best = choose_symbols(nearest[rows].ravel().astype(np.int64), cost, places, bits, distortion, reach)
                error[rows] += cost(best).reshape(shape).sum(axis=1)
                rate[rows] += look_up_bits(best, places, bits).reshape(shape).sum(axis=1)
                symbols[rows] = best.reshape(shape)
            chosen.append(symbols)
        share = np.clip(np.bincount(classes, flags, class_count) / members, 1e-3, 1 - 1e-3)
        rate += np.log2((1 - share) / share)[classes]
        flags = error + price * rate < zero_error
    flags &= np.any([(symbols != 0).any(axis=1) for symbols in chosen], axis=0)
    return ResidualSymbols(flags, [codes for _, _, _, codes, _, _ in bands], [symbols[flags] for symbols in chosen])


def residual_sensitivity(sensitivity: Sensitivity, group: str, columns: int) -> np.ndarray:
    """Return the sensitivities (N, columns) of residuals of a section."""
    if group == HARMONICS:
        assert sensitivity.harmonics is not None
        return np.broadcast_to(sensitivity.harmonics[:, None], (len(sensitivity.harmonics), columns))
    assert sensitivity.shapes is not None
    return sensitivity.shapes


def split_colors(values: np.ndarray, basis: np.ndarray) -> np.ndarray:
    """Transform red, green and blue of each harmonic (N, 3 K) to components in an orthonormal basis, float64."""
    parts = values.reshape(len(values), values.shape[1] // 3, 3) @ basis.astype(np.float64)
    return parts.reshape(values.shape)


def _added_error(weights: np.ndarray, wanted: np.ndarray, steps: np.ndarray, symbols: np.ndarray) -> np.ndarray:
    return weights * (symbols * steps - wanted) ** 2

"""Quantisation of the numbers of hash tables and decoders, in groups that share a step."""

from __future__ import annotations

from functools import partial

import numpy as np

from hyrfpack.compress.rate_distortion import (
    LAMBDA_PER_DISTORTION,
    choose_step_codes,
    choose_symbols,
    estimate_code_bits,
)
from hyrfpack.format.compact.groups import ENTROPY_MODEL_COUNT, GroupSymbols, StepGroups, iter_blocks
from hyrfpack.quant.rans import uses_numba
from hyrfpack.quant.steps import ALL_ZERO_CODE, FIXED_POINT_ONE, MAX_ABS_SYMBOL, decode_step

# Lower bound of a number's sensitivity, as a share of the mean of its group.
_MIN_RELATIVE_SENSITIVITY = 0.01


def quantize_groups(
    values: np.ndarray,
    groups: StepGroups,
    sensitivity: np.ndarray,
    distortion: float,
    reach: int = 1,
    implementation: str = "auto",
) -> GroupSymbols:
    """Choose the step of each group and the symbol of each number.

    Args:
        values: (n,) float.
        groups: the group of each number.
        sensitivity: (n,) sensitivity s of each number; groups whose sensitivity is 0 are stored as zeros.
        distortion: D, the error that each number may add, see `hyrfpack.compress.rate_distortion`.
        reach: distance in steps of the furthest candidate from the nearest symbol; 0 takes the nearest and ignores
            the rate.
        implementation: "numpy", "cpu" (Numba) or "auto"; the symbols are the same.
    """
    index, count = groups.index, groups.count
    members = np.maximum(np.bincount(index, minlength=count), 1)
    codes, mean = choose_group_codes(groups, sensitivity, distortion)
    steps, unread = decode_step(codes) / FIXED_POINT_ONE, codes == ALL_ZERO_CODE
    symbols = np.empty(len(values), np.int64)
    for part in iter_blocks(len(values)):
        nearest = np.rint(values[part] / steps[index[part]])
        symbols[part] = np.where(unread[index[part]], 0, np.clip(nearest, -MAX_ABS_SYMBOL, MAX_ABS_SYMBOL))
    models = _model_indices(np.bincount(index, np.abs(symbols), count) / members)
    if reach:
        contexts = groups.gather(models)
        bits = estimate_code_bits(symbols, contexts, ENTROPY_MODEL_COUNT, reach)
        min_sensitivity = _MIN_RELATIVE_SENSITIVITY * mean
        if uses_numba(implementation):
            from hyrfpack.compress import quantization_kernels

            table, lowest = bits
            rates = LAMBDA_PER_DISTORTION * distortion * table
            quantization_kernels.choose_group_symbols(
                values, index, steps, min_sensitivity, sensitivity, contexts, rates, lowest, reach, symbols
            )
        else:
            for part in iter_blocks(len(values)):
                weights = np.maximum(sensitivity[part], min_sensitivity[index[part]])
                error = partial(_squared_errors, weights, steps[index[part]], values[part])
                symbols[part] = choose_symbols(symbols[part], error, contexts[part], bits, distortion, reach)
        for part in iter_blocks(len(values)):
            chosen = np.clip(symbols[part], -MAX_ABS_SYMBOL, MAX_ABS_SYMBOL)
            symbols[part] = np.where(unread[index[part]], 0, chosen)
    codes[np.bincount(index, np.abs(symbols), count) == 0] = ALL_ZERO_CODE
    return GroupSymbols(codes, models, symbols, (symbols * groups.gather(steps)).astype(np.float32))


def _squared_errors(weights: np.ndarray, steps: np.ndarray, values: np.ndarray, symbols: np.ndarray) -> np.ndarray:
    """Return the weighted squared error (n,) of candidate symbols (n,) for values (n,)."""
    return weights * (symbols * steps - values) ** 2


def choose_group_codes(groups: StepGroups, sensitivity: np.ndarray, distortion: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the step code (count,) uint8 and the mean sensitivity (count,) of each group.

    Groups whose sensitivity is 0 have ALL_ZERO_CODE. The arguments are those of `quantize_groups`.
    """
    members = np.maximum(np.bincount(groups.index, minlength=groups.count), 1)
    mean = np.bincount(groups.index, sensitivity, groups.count) / members
    codes = np.where(mean > 0, choose_step_codes(np.where(mean > 0, mean, 1), distortion), ALL_ZERO_CODE)
    return codes.astype(np.uint8), mean


def _model_indices(magnitude: np.ndarray) -> np.ndarray:
    """Return the entropy coding model (count,) uint8 of each group, by the mean magnitude of its symbols.

    The magnitudes that separate the models double from 1/16 to 4 steps.
    """
    return np.clip(np.floor(np.log2(np.maximum(magnitude, 1e-9))) + 5, 0, ENTROPY_MODEL_COUNT - 1).astype(np.uint8)

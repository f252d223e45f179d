"""The steps and symbols of numbers in groups: of hash tables and decoders."""

from __future__ import annotations

import numpy as np

from hyrfpack.compress.rate_distortion import best_steps, cheapest, code_bits
from hyrfpack.format.compact.groups import ENTROPY_MODEL_COUNT, MAX_ABS_SYMBOL, GroupSymbols, StepGroups, iter_blocks
from hyrfpack.quant.steps import NOT_CODED, ONE, step_of

_FLOOR = 0.01  # least sensitivity of a number against the mean of its group


def quantize_groups(
    values: np.ndarray, groups: StepGroups, sensitivity: np.ndarray, distortion: float, reach: int = 1
) -> GroupSymbols:
    """Choose the steps and the symbols.

    Args:
        values: (n,) float.
        sensitivity: (n,) s of each number; groups without any are stored as zeros.
        distortion: D, what each number may add, see `hyrfpack.compress.rate_distortion`.
        reach: how many steps from the nearest are tried; 0 takes the nearest, without counting bits.
    """
    index, count = groups.index, groups.count
    members = np.maximum(np.bincount(index, minlength=count), 1)
    mean = np.bincount(index, sensitivity, count) / members
    codes = np.where(mean > 0, best_steps(np.where(mean > 0, mean, 1), distortion), NOT_CODED).astype(np.uint8)
    steps, unread = step_of(codes) / ONE, codes == NOT_CODED
    symbols = np.empty(len(values), np.int64)
    for part in iter_blocks(len(values)):
        nearest = np.rint(values[part] / steps[index[part]])
        symbols[part] = np.where(unread[index[part]], 0, np.clip(nearest, -MAX_ABS_SYMBOL, MAX_ABS_SYMBOL))
    models = _models(np.bincount(index, np.abs(symbols), count) / members)
    if reach:
        contexts = groups.gather(models)
        bits = code_bits(symbols, contexts, ENTROPY_MODEL_COUNT, reach)
        for part in iter_blocks(len(values)):
            weights, step = np.maximum(sensitivity[part], (_FLOOR * mean)[index[part]]), steps[index[part]]

            def error(candidates: np.ndarray, weights=weights, step=step, wanted=values[part]) -> np.ndarray:
                return weights * (candidates * step - wanted) ** 2

            chosen = cheapest(symbols[part], error, contexts[part], bits, distortion, reach)
            symbols[part] = np.where(unread[index[part]], 0, np.clip(chosen, -MAX_ABS_SYMBOL, MAX_ABS_SYMBOL))
    codes[np.bincount(index, np.abs(symbols), count) == 0] = NOT_CODED
    return GroupSymbols(codes, models, symbols, (symbols * groups.gather(steps)).astype(np.float32))


def _models(magnitude: np.ndarray) -> np.ndarray:
    """The model for groups of these mean magnitudes in steps, (count,) uint8: they double from 1/16 to 4."""
    return np.clip(np.floor(np.log2(np.maximum(magnitude, 1e-9))) + 5, 0, ENTROPY_MODEL_COUNT - 1).astype(np.uint8)

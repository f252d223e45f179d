"""Numba kernels that choose symbols by rate and distortion.

They do the arithmetic of `quant.lifting.lift` and `rate_distortion.choose_symbols` in the same order, so the symbols
are the same.
"""

from __future__ import annotations

import math

import numpy as np

from hyrfpack.parallel.compiled import compiled

njit = compiled(error_model="numpy")


@njit
def _added_error(number, target, weight, field_logit, saturates):
    """Return weight (x - target)^2 of a number x, or of sigmoid(field_logit + x) if the number saturates."""
    if saturates:
        number = 1 / (1 + math.exp(-(field_logit + number)))
    difference = number - target
    return weight * (difference * difference)


@njit
def _look_up(rates, symbol, lowest):
    """Return the rate of a symbol; those beyond the ends of the table have the rates at its ends."""
    return rates[np.uint64(min(max(symbol - lowest, 0), len(rates) - 1))]


@njit
def _cheapest_symbol(nearest, reach, start, step, scale, offset, target, weight, field_logit, saturates, rates, lowest):
    """Return the symbol with the lowest cost within `reach` of `nearest`; it stands for (start + symbol step) / scale +
    offset."""
    best, least_cost = nearest, np.inf
    for place in range(2 * reach + 1):
        # The shifts are 0, -1, 1, -2, 2, ..., and of equal costs the first one is taken.
        shift = (place + 1) // 2
        symbol = nearest - shift if place % 2 else nearest + shift
        number = (start + symbol * step) / scale + offset
        error = _added_error(number, target, weight, field_logit, saturates)
        cost = error + _look_up(rates, symbol, lowest)
        if cost < least_cost:
            best, least_cost = symbol, cost
    return best


@njit
def lift_channel(
    levels, weight, fixed, classes, steps, reach, scale, mean, targets, weights, field_logits, rates, lowest,
    symbols, values,
):  # fmt: skip
    """Choose the symbols of a channel: the nearest ones if `reach` is 0, else the cheapest ones within `reach`.

    Args:
        levels: (L, 3) int64 first place, stride, and distance to the neighbours of each level of the prediction.
        weight: weight of the prediction in 16ths.
        fixed: (N,) int64 numbers in fixed point, less the mean.
        classes: (N,) uint8.
        steps: (K,) int64 step of each class in fixed point.
        scale: one in fixed point.
        mean: float64 that is added to decoded numbers.
        targets, weights: (N,) float64; see `_added_error`.
        field_logits: (N,) float64; empty if numbers do not saturate.
        rates: (K, S) float64 cost of the bits of each symbol in each class.
        lowest: the first symbol of `rates`.
        symbols: (N,) int64 output.
        values: (N,) int64 output, the decoded numbers in fixed point, less the mean.
    """
    count, saturates = len(fixed), len(field_logits) > 0
    for level in range(len(levels)):
        first, stride, distance = levels[level]
        for place in range(first, count, stride):
            prediction = np.int64(0)
            if distance:
                before = values[place - distance]
                after = values[place + distance] if place + distance < count else before
                prediction = (before + after) * weight >> 5
            kind = np.uint64(classes[place])
            step = steps[kind]
            symbol = (fixed[place] - prediction + (step >> 1)) // step
            if reach:
                symbol = _cheapest_symbol(
                    symbol, reach, prediction, step, scale, mean, targets[place], weights[place],
                    field_logits[place] if saturates else 0.0, saturates, rates[kind], lowest,
                )  # fmt: skip
            symbols[place] = symbol
            values[place] = prediction + symbol * step


@njit
def sum_channel_costs(symbols, values, classes, scale, mean, targets, weights, field_logits, rates, lowest):
    """Return the sum of errors and rates of a channel's symbols; the arguments are those of `lift_channel`."""
    total, saturates = 0.0, len(field_logits) > 0
    for place in range(len(symbols)):
        number = values[place] / scale + mean
        field_logit = field_logits[place] if saturates else 0.0
        total += _added_error(number, targets[place], weights[place], field_logit, saturates)
        total += _look_up(rates[np.uint64(classes[place])], symbols[place], lowest)
    return total


@njit
def choose_group_symbols(values, index, steps, min_weights, weights, contexts, rates, lowest, reach, symbols):
    """Replace the nearest symbols of numbers in groups by the cheapest ones within `reach`.

    Args:
        values: (n,) float64 or float32 numbers.
        index: (n,) group of each number.
        steps: (count,) float64 step of each group.
        min_weights: (count,) float64 lower bound of the weights in each group.
        weights: (n,) float64 weight of the squared error.
        contexts: (n,) uint8 class of each symbol.
        rates, lowest: as for `lift_channel`.
        symbols: (n,) int64 nearest symbols, replaced.
    """
    for place in range(len(values)):
        group = np.uint64(index[place])
        weight = max(weights[place], min_weights[group])
        symbols[place] = _cheapest_symbol(
            symbols[place], reach, 0.0, steps[group], 1.0, 0.0, np.float64(values[place]), weight, 0.0, False,
            rates[np.uint64(contexts[place])], lowest,
        )  # fmt: skip

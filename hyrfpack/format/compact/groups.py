"""Numbers in groups, each with a step of its own. The decoder knows which number is in which group.

Groups are coded with one of a few models, by how far their symbols spread; a group of zeros takes nothing.
The bytes: u32 and u32 lengths of the two streams that follow, step codes and models; then the stream of the symbols.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from hyrfpack.format.compact.quantize import best_steps, cheapest, code_bits
from hyrfpack.quant import DamagedDataError
from hyrfpack.quant.integers import decode_integers, encode_integers
from hyrfpack.quant.steps import NOT_CODED, ONE, step_of

MODELS = 8  # of the entropy coder
LARGEST = 1 << 24  # steps from zero
_PART = 1 << 15
_FLOOR = 0.01  # least sensitivity of a number against the mean of its group
_HEADER = struct.Struct("<II")


@dataclass(frozen=True)
class Groups:
    """Which number is in which group.

    Attributes:
        index: (n,) integers of any width, 0 to count - 1.
        count: how many groups there may be.
    """

    index: np.ndarray
    count: int

    def spread(self, values: np.ndarray) -> np.ndarray:
        """(n,) the value of each number's group, of `values` (count,)."""
        result = np.empty(len(self.index), values.dtype)
        for part in _parts(len(result)):
            result[part] = values.take(self.index[part])
        return result


@dataclass(frozen=True)
class GroupSymbols:
    """Quantised numbers in groups.

    Attributes:
        codes: (count,) uint8 step codes, NOT_CODED for groups of zeros.
        models: (count,) uint8, 0 to MODELS - 1.
        symbols: (n,) int64, in steps.
        values: (n,) float32, as they will be decoded.
    """

    codes: np.ndarray
    models: np.ndarray
    symbols: np.ndarray
    values: np.ndarray


def quantize_groups(
    values: np.ndarray, groups: Groups, sensitivity: np.ndarray, distortion: float, reach: int = 1
) -> GroupSymbols:
    """Choose the steps and the symbols.

    Args:
        values: (n,) float.
        sensitivity: (n,) s of each number; groups without any are stored as zeros.
        distortion: D, see `quantize`.
        reach: how many steps from the nearest are tried; 0 takes the nearest, without counting bits.
    """
    index, count = groups.index, groups.count
    members = np.maximum(np.bincount(index, minlength=count), 1)
    mean = np.bincount(index, sensitivity, count) / members
    codes = np.where(mean > 0, best_steps(np.where(mean > 0, mean, 1), distortion), NOT_CODED).astype(np.uint8)
    steps, unread = step_of(codes) / ONE, codes == NOT_CODED
    symbols = np.empty(len(values), np.int64)
    for part in _parts(len(values)):
        nearest = np.rint(values[part] / steps[index[part]])
        symbols[part] = np.where(unread[index[part]], 0, np.clip(nearest, -LARGEST, LARGEST))
    models = _models(np.bincount(index, np.abs(symbols), count) / members)
    if reach:
        contexts = groups.spread(models)
        bits = code_bits(symbols, contexts, MODELS, reach)
        for part in _parts(len(values)):
            weights, step = np.maximum(sensitivity[part], (_FLOOR * mean)[index[part]]), steps[index[part]]

            def error(candidates: np.ndarray, weights=weights, step=step, wanted=values[part]) -> np.ndarray:
                return weights * (candidates * step - wanted) ** 2

            chosen = cheapest(symbols[part], error, contexts[part], bits, distortion, reach)
            symbols[part] = np.where(unread[index[part]], 0, np.clip(chosen, -LARGEST, LARGEST))
    codes[np.bincount(index, np.abs(symbols), count) == 0] = NOT_CODED
    return GroupSymbols(codes, models, symbols, (symbols * groups.spread(steps)).astype(np.float32))


def encode_groups(chosen: GroupSymbols, groups: Groups) -> bytes:
    """The bytes of numbers in groups."""
    coded = groups.spread(chosen.codes != NOT_CODED)
    codes = encode_integers(chosen.codes)
    models = encode_integers(chosen.models[chosen.codes != NOT_CODED])
    symbols = encode_integers(chosen.symbols[coded], groups.spread(chosen.models)[coded], signed=True)
    return _HEADER.pack(len(codes), len(models)) + codes + models + symbols


def decode_groups(data: memoryview, groups: Groups) -> np.ndarray:
    """The numbers (n,) float32.

    Raises:
        DamagedDataError: the bytes are truncated, damaged or contradict themselves.
    """
    if len(data) < _HEADER.size or sum(_HEADER.unpack_from(data)) > len(data) - _HEADER.size:
        raise DamagedDataError(f"the lengths of its parts do not fit its {len(data)} bytes; it is damaged")
    first, second = _HEADER.unpack_from(data)
    data = data[_HEADER.size :]
    codes = decode_integers(data[:first], groups.count)
    if codes.max(initial=0) > 255:
        raise DamagedDataError(f"the step code {codes.max()} is above 255; it is damaged")
    used = codes != NOT_CODED
    chosen = decode_integers(data[first : first + second], np.count_nonzero(used))
    if chosen.max(initial=0) >= MODELS:
        raise DamagedDataError(f"the model {chosen.max()} of {MODELS}; it is damaged")
    models = np.full(groups.count, MODELS, np.uint8)
    models[used] = chosen
    contexts = groups.spread(models)
    coded = contexts < MODELS
    contexts = contexts[coded]
    symbols = decode_integers(data[first + second :], len(contexts), contexts, signed=True)
    if symbols.max(initial=0) > LARGEST or symbols.min(initial=0) < -LARGEST:
        raise DamagedDataError(f"a number is more than {LARGEST} steps; it is damaged")
    values = np.zeros(len(groups.index), np.float32)
    steps, place = step_of(codes) / ONE, 0
    for part in _parts(len(values)):
        index = groups.index[part][coded[part]]
        values[part][coded[part]] = symbols[place : place + len(index)] * steps[index]
        place += len(index)
    return values


def _models(magnitude: np.ndarray) -> np.ndarray:
    """The model for groups of these mean magnitudes in steps, (count,) uint8: they double from 1/16 to 4."""
    return np.clip(np.floor(np.log2(np.maximum(magnitude, 1e-9))) + 5, 0, MODELS - 1).astype(np.uint8)


def _parts(count: int) -> Iterator[slice]:
    """Consecutive parts of a list of numbers, few enough in each that temporaries stay in the caches."""
    return (slice(first, first + _PART) for first in range(0, count, _PART))

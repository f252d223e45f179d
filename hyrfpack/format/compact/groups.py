"""Numbers in groups, each with a step of its own. The decoder knows which number is in which group.

Groups are coded with one of a few models, by how far their symbols spread; a group of zeros takes nothing.
The bytes: u32 and u32 lengths of the two streams that follow, step codes and models; then the stream of the symbols.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from hyrfpack.quant import DamagedDataError
from hyrfpack.quant.integers import decode_integers, encode_integers
from hyrfpack.quant.steps import NOT_CODED, ONE, step_of

MODELS = 8  # of the entropy coder
LARGEST = 1 << 24  # steps from zero
_PART = 1 << 15
_HEADER = struct.Struct("<II")


def parts(count: int) -> Iterator[slice]:
    """Consecutive parts of a list of numbers, few enough in each that temporaries stay in the caches."""
    return (slice(first, first + _PART) for first in range(0, count, _PART))


@dataclass(frozen=True)
class StepGroups:
    """Which numbers have a step in common.

    Attributes:
        index: (n,) integers of any width, 0 to count - 1.
        count: how many groups there may be.
    """

    index: np.ndarray
    count: int

    def spread(self, values: np.ndarray) -> np.ndarray:
        """(n,) the value of each number's group, of `values` (count,)."""
        result = np.empty(len(self.index), values.dtype)
        for part in parts(len(result)):
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


def encode_groups(chosen: GroupSymbols, groups: StepGroups) -> bytes:
    """The bytes of numbers in groups."""
    coded = groups.spread(chosen.codes != NOT_CODED)
    codes = encode_integers(chosen.codes)
    models = encode_integers(chosen.models[chosen.codes != NOT_CODED])
    symbols = encode_integers(chosen.symbols[coded], groups.spread(chosen.models)[coded], signed=True)
    return _HEADER.pack(len(codes), len(models)) + codes + models + symbols


def decode_groups(data: memoryview, groups: StepGroups) -> np.ndarray:
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
    chosen = decode_integers(data[first : first + second], int(np.count_nonzero(used)))
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
    for part in parts(len(values)):
        index = groups.index[part][coded[part]]
        values[part][coded[part]] = symbols[place : place + len(index)] * steps[index]
        place += len(index)
    return values

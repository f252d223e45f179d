"""Coding of numbers in groups with one quantisation step per group. The decoder knows the group of each number.

The symbols of a group are coded with one of a few entropy models, chosen by their spread; a group of zeros takes no
symbols. The bytes are: u32 length of the stream of step codes, u32 length of the stream of models, these two streams,
and the stream of the symbols.

The groups of a table that other files share are stored, too (section codec 11, "stated groups"), because its readers
do not have the positions
from which encoders find them: u32 length of the stream of usage classes, this stream, and the bytes above.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from hyrfpack.quant import DamagedDataError
from hyrfpack.quant.integers import decode_integers, encode_integers
from hyrfpack.quant.steps import ALL_ZERO_CODE, FIXED_POINT_ONE, MAX_ABS_SYMBOL, decode_step

ENTROPY_MODEL_COUNT = 8
_NUMBERS_PER_BLOCK = 1 << 15  # small enough that temporary arrays stay in the caches
_HEADER_STRUCT = struct.Struct("<II")
_LENGTH_STRUCT = struct.Struct("<I")


def iter_blocks(count: int) -> Iterator[slice]:
    """Yield consecutive slices of a list of `count` numbers, short enough that temporary arrays stay in the caches."""
    return (slice(first, first + _NUMBERS_PER_BLOCK) for first in range(0, count, _NUMBERS_PER_BLOCK))


@dataclass(frozen=True)
class StepGroups:
    """Assignment of numbers to groups that share a quantisation step.

    Attributes:
        index: (n,) group of each number: integers of any width, 0 to count - 1.
        count: number of groups; some may be empty.
    """

    index: np.ndarray
    count: int

    def gather(self, values: np.ndarray) -> np.ndarray:
        """Return the value of each number's group, (n,), given the groups' `values` (count,)."""
        result = np.empty(len(self.index), values.dtype)
        for part in iter_blocks(len(result)):
            result[part] = values.take(self.index[part])
        return result


@dataclass(frozen=True)
class GroupSymbols:
    """Quantised numbers in groups.

    Attributes:
        codes: (count,) uint8 step codes, ALL_ZERO_CODE for groups of zeros.
        models: (count,) uint8 entropy model of each group, 0 to ENTROPY_MODEL_COUNT - 1.
        symbols: (n,) int64 numbers in steps, at most MAX_ABS_SYMBOL in magnitude.
        values: (n,) float32 numbers as they will be decoded.
    """

    codes: np.ndarray
    models: np.ndarray
    symbols: np.ndarray
    values: np.ndarray


def encode_groups(quantized: GroupSymbols, groups: StepGroups) -> bytes:
    """Encode quantised numbers in groups as bytes."""
    is_coded_group = quantized.codes != ALL_ZERO_CODE
    is_coded = groups.gather(is_coded_group)
    codes = encode_integers(quantized.codes)
    models = encode_integers(quantized.models[is_coded_group])
    symbols = encode_integers(quantized.symbols[is_coded], groups.gather(quantized.models)[is_coded], signed=True)
    return _HEADER_STRUCT.pack(len(codes), len(models)) + codes + models + symbols


def decode_groups(data: memoryview, groups: StepGroups) -> np.ndarray:
    """Decode numbers in groups.

    Args:
        data: the bytes, no more and no fewer.
        groups: the groups that the encoder used.

    Returns:
        (n,) float32.

    Raises:
        DamagedDataError: the bytes are truncated, damaged or inconsistent.
    """
    if len(data) < _HEADER_STRUCT.size or sum(_HEADER_STRUCT.unpack_from(data)) > len(data) - _HEADER_STRUCT.size:
        raise DamagedDataError(f"the lengths of its parts do not fit its {len(data)} bytes; it is damaged")
    code_bytes, model_bytes = _HEADER_STRUCT.unpack_from(data)
    data = data[_HEADER_STRUCT.size :]
    codes = decode_integers(data[:code_bytes], groups.count)
    if codes.max(initial=0) > 255:
        raise DamagedDataError(f"the step code {codes.max()} is above 255; it is damaged")
    is_coded_group = codes != ALL_ZERO_CODE
    coded_models = decode_integers(data[code_bytes : code_bytes + model_bytes], int(np.count_nonzero(is_coded_group)))
    if coded_models.max(initial=0) >= ENTROPY_MODEL_COUNT:
        raise DamagedDataError(
            f"a group has the entropy model {coded_models.max()}, and there are {ENTROPY_MODEL_COUNT}; it is damaged"
        )
    models = np.full(groups.count, ENTROPY_MODEL_COUNT, np.uint8)
    models[is_coded_group] = coded_models
    contexts = groups.gather(models)
    is_coded = contexts < ENTROPY_MODEL_COUNT
    contexts = contexts[is_coded]
    symbols = decode_integers(data[code_bytes + model_bytes :], len(contexts), contexts, signed=True)
    if symbols.max(initial=0) > MAX_ABS_SYMBOL or symbols.min(initial=0) < -MAX_ABS_SYMBOL:
        raise DamagedDataError(f"a number is more than {MAX_ABS_SYMBOL} steps; it is damaged")
    values = np.zeros(len(groups.index), np.float32)
    steps, start = decode_step(codes) / FIXED_POINT_ONE, 0
    for block in iter_blocks(len(values)):
        index = groups.index[block][is_coded[block]]
        values[block][is_coded[block]] = symbols[start : start + len(index)] * steps[index]
        start += len(index)
    return values


def encode_usage_classes(groups: StepGroups, offsets: Sequence[int], classes_per_level: int) -> bytes:
    """Encode the usage classes of a table's rows as bytes that go before those of `encode_groups`.

    Args:
        groups: groups of the table's numbers, two for each row.
        offsets: first row of each level, and the number of rows.
        classes_per_level: groups of a level.
    """
    levels = np.repeat(np.arange(len(offsets) - 1), np.diff(offsets))
    stream = encode_integers(groups.index[::2].astype(np.int64) - classes_per_level * levels, levels.astype(np.uint8))
    return _LENGTH_STRUCT.pack(len(stream)) + stream


def decode_usage_classes(
    data: memoryview, offsets: Sequence[int], classes_per_level: int
) -> tuple[StepGroups, memoryview]:
    """Decode the usage classes of a table's rows; return the groups that they make, and the bytes that follow.

    Raises:
        DamagedDataError: the bytes are truncated, damaged or inconsistent.
    """
    if len(data) < _LENGTH_STRUCT.size or _LENGTH_STRUCT.unpack_from(data)[0] > len(data) - _LENGTH_STRUCT.size:
        raise DamagedDataError(f"its usage classes do not fit its {len(data)} bytes; it is damaged")
    end = _LENGTH_STRUCT.size + _LENGTH_STRUCT.unpack_from(data)[0]
    levels = np.repeat(np.arange(len(offsets) - 1), np.diff(offsets))
    classes = decode_integers(data[_LENGTH_STRUCT.size : end], len(levels), levels.astype(np.uint8))
    if classes.max(initial=0) >= classes_per_level:
        raise DamagedDataError(
            f"a row has the usage class {classes.max()}, and there are {classes_per_level}; it is damaged"
        )
    index = (classes_per_level * levels + classes).astype(np.uint16)
    return StepGroups(np.repeat(index, 2), classes_per_level * (len(offsets) - 1)), data[end:]

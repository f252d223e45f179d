"""Step groups of profile compact: hostile bytes are refused."""

from __future__ import annotations

import struct
import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from property_tests import examples

from hyrfpack.compress.groups import quantize_groups
from hyrfpack.format.compact.groups import (
    StepGroups,
    decode_groups,
    decode_usage_classes,
    encode_groups,
    encode_usage_classes,
)
from hyrfpack.quant import DamagedDataError
from hyrfpack.quant.integers import encode_integers
from hyrfpack.quant.steps import MAX_ABS_SYMBOL


def random_groups(count: int, groups: int, seed: int = 0) -> StepGroups:
    return StepGroups(np.random.default_rng(seed).integers(groups, size=count), groups)


def laplace_values(groups: StepGroups, seed: int = 1) -> np.ndarray:
    """Return Laplace-distributed values whose scale grows from group to group."""
    return np.random.default_rng(seed).laplace(size=len(groups.index)) * 1.3 ** (groups.index % 10)


# Hostile bytes.

SAMPLE_GROUPS = random_groups(90, 12)
SAMPLE_DATA = encode_groups(
    quantize_groups(laplace_values(SAMPLE_GROUPS), SAMPLE_GROUPS, np.ones(90), 1e-2), SAMPLE_GROUPS
)
HEADER_STRUCT = struct.Struct("<II")  # step code bytes, model bytes


def test_truncation_at_every_byte_and_trailing_bytes_are_refused() -> None:
    for length in range(len(SAMPLE_DATA)):
        with pytest.raises(DamagedDataError):
            decode_groups(memoryview(SAMPLE_DATA)[:length], SAMPLE_GROUPS)
    with pytest.raises(DamagedDataError):
        decode_groups(memoryview(SAMPLE_DATA + b"\0"), SAMPLE_GROUPS)


@given(st.data())
@examples(200)
def test_damaged_data_is_refused_or_decodes_to_finite_values(data: st.DataObject) -> None:
    damaged = bytearray(SAMPLE_DATA)
    for _ in range(data.draw(st.integers(1, 4))):
        damaged[data.draw(st.integers(0, len(damaged) - 1))] ^= data.draw(st.integers(1, 255))

    try:
        decoded = decode_groups(memoryview(bytes(damaged)), SAMPLE_GROUPS)
    except DamagedDataError:
        return
    assert decoded.shape == (90,) and np.isfinite(decoded).all()


@pytest.mark.parametrize("lengths", [(0, 0), (2**32 - 1, 0), (0, 2**32 - 1), (2**32 - 1, 2**32 - 1)])
def test_invalid_lengths_are_refused_in_little_memory(lengths: tuple[int, int]) -> None:
    tracemalloc.start()
    with pytest.raises(DamagedDataError):
        decode_groups(memoryview(HEADER_STRUCT.pack(*lengths) + SAMPLE_DATA[HEADER_STRUCT.size :]), SAMPLE_GROUPS)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()

    assert peak < 1 << 20


def encode_raw_groups(codes: list[int], models: list[int], symbols: list[int], contexts: list[int]) -> bytes:
    """Encode groups without checking any value."""
    first, second = encode_integers(np.array(codes)), encode_integers(np.array(models))
    third = encode_integers(np.array(symbols), np.array(contexts, np.uint8), signed=True)
    return HEADER_STRUCT.pack(len(first), len(second)) + first + second + third


TWO_GROUPS = StepGroups(np.array([0, 1, 1]), 2)


def test_hand_made_bytes_are_decoded() -> None:
    data = encode_raw_groups([0, 192], [7], [5, -3], [7, 7])  # step 192 is 8 * 2^24 units

    assert decode_groups(memoryview(data), TWO_GROUPS).tolist() == [0, 40, -24]


@pytest.mark.parametrize(
    ("data", "claim"),
    [
        (encode_raw_groups([256, 192], [0, 0], [1, 1, 1], [0, 0, 0]), "step code"),
        (encode_raw_groups([2**50, 192], [0, 0], [1, 1, 1], [0, 0, 0]), "step code"),
        (encode_raw_groups([192, 192], [8, 0], [1, 1, 1], [8, 0, 0]), "model"),
        (encode_raw_groups([192, 192], [2**40, 0], [1, 1, 1], [0, 0, 0]), "model"),
        (encode_raw_groups([192, 192], [0, 0], [1, 1, MAX_ABS_SYMBOL + 1], [0, 0, 0]), "steps"),
        (encode_raw_groups([192, 192], [0, 0], [1, 1, -MAX_ABS_SYMBOL - 1], [0, 0, 0]), "steps"),
        (encode_raw_groups([192, 192], [0, 0], [1, -(2**54), 1], [0, 0, 0]), "steps"),
    ],
)
def test_codes_models_and_symbols_out_of_range_are_refused(data: bytes, claim: str) -> None:
    with pytest.raises(DamagedDataError, match=claim):
        decode_groups(memoryview(data), TWO_GROUPS)


def test_the_largest_float32_values_are_supported() -> None:
    data = encode_raw_groups([1, 255], [0, 0], [MAX_ABS_SYMBOL, MAX_ABS_SYMBOL, -MAX_ABS_SYMBOL], [0, 0, 0])

    np.testing.assert_array_equal(
        decode_groups(memoryview(data), TWO_GROUPS),
        np.float32([9.0, 1920.0 * MAX_ABS_SYMBOL, -1920.0 * MAX_ABS_SYMBOL]),
    )


def test_decoding_takes_at_most_60_bytes_per_value() -> None:
    groups = random_groups(100_000, 100)
    data = encode_groups(quantize_groups(laplace_values(groups), groups, np.ones(100_000), 1e-2), groups)
    decode_groups(memoryview(data), groups)

    tracemalloc.start()
    decode_groups(memoryview(data), groups)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()

    assert peak < 60 * 100_000


# Stated groups.

LEVEL_OFFSETS = (0, 8, 35, 99)  # first rows of three levels, and the number of rows


def stated_groups(seed: int = 0) -> StepGroups:
    """Return groups of the two numbers of each row: a usage class below 11 for each row of a level."""
    levels = np.repeat(np.arange(3), np.diff(LEVEL_OFFSETS))
    uses = np.random.default_rng(seed).integers(11, size=len(levels))
    return StepGroups(np.repeat(16 * levels + uses, 2).astype(np.uint16), 48)


def test_stated_groups_are_decoded_as_they_were_encoded_and_leave_the_rest() -> None:
    groups = stated_groups()

    decoded, rest = decode_usage_classes(
        memoryview(encode_usage_classes(groups, LEVEL_OFFSETS, 16) + b"rest"), LEVEL_OFFSETS, 16
    )

    np.testing.assert_array_equal(decoded.index, groups.index)
    assert decoded.count == 48 and bytes(rest) == b"rest"


@given(st.data())
@examples(100)
def test_damaged_usage_classes_are_refused_or_in_range(data: st.DataObject) -> None:
    damaged = bytearray(encode_usage_classes(stated_groups(), LEVEL_OFFSETS, 16))
    for _ in range(data.draw(st.integers(1, 3))):
        damaged[data.draw(st.integers(0, len(damaged) - 1))] ^= data.draw(st.integers(1, 255))
    length = data.draw(st.integers(0, len(damaged)))

    try:
        decoded, _ = decode_usage_classes(memoryview(bytes(damaged))[:length], LEVEL_OFFSETS, 16)
    except DamagedDataError:
        return
    assert decoded.index.shape == (198,) and decoded.index.max() < 48

"""Bytes of numbers in groups: what hostile ones meet."""

from __future__ import annotations

import struct
import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hyrfpack.compress.groups import quantize_groups
from hyrfpack.format.compact.groups import MAX_ABS_SYMBOL, StepGroups, decode_groups, encode_groups
from hyrfpack.quant import DamagedDataError
from hyrfpack.quant.integers import encode_integers


def random_groups(count: int, groups: int, seed: int = 0) -> StepGroups:
    return StepGroups(np.random.default_rng(seed).integers(groups, size=count), groups)


def laplace(groups: StepGroups, seed: int = 1) -> np.ndarray:
    """Numbers that are wider from group to group."""
    return np.random.default_rng(seed).laplace(size=len(groups.index)) * 1.3 ** (groups.index % 10)


# Bytes that nobody should have written.

GROUPS = random_groups(90, 12)
SMALL = encode_groups(quantize_groups(laplace(GROUPS), GROUPS, np.ones(90), 1e-2), GROUPS)
HEADER = struct.Struct("<II")  # bytes of step codes, bytes of models


def test_truncation_at_every_byte_and_trailing_bytes_are_refused() -> None:
    for length in range(len(SMALL)):
        with pytest.raises(DamagedDataError):
            decode_groups(memoryview(SMALL)[:length], GROUPS)
    with pytest.raises(DamagedDataError):
        decode_groups(memoryview(SMALL + b"\0"), GROUPS)


@given(st.data())
@settings(max_examples=200, deadline=None)
def test_damage_is_refused_or_yields_as_many_finite_numbers(data: st.DataObject) -> None:
    damaged = bytearray(SMALL)
    for _ in range(data.draw(st.integers(1, 4))):
        damaged[data.draw(st.integers(0, len(damaged) - 1))] ^= data.draw(st.integers(1, 255))

    try:
        decoded = decode_groups(memoryview(bytes(damaged)), GROUPS)
    except DamagedDataError:
        return
    assert decoded.shape == (90,) and np.isfinite(decoded).all()


@pytest.mark.parametrize("lengths", [(0, 0), (2**32 - 1, 0), (0, 2**32 - 1), (2**32 - 1, 2**32 - 1)])
def test_lengths_that_cannot_be_are_refused(lengths: tuple[int, int]) -> None:
    tracemalloc.start()
    with pytest.raises(DamagedDataError):
        decode_groups(memoryview(HEADER.pack(*lengths) + SMALL[HEADER.size :]), GROUPS)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()

    assert peak < 1 << 20


def written(codes: list[int], models: list[int], symbols: list[int], contexts: list[int]) -> bytes:
    """The bytes of groups with any numbers in them."""
    first, second = encode_integers(np.array(codes)), encode_integers(np.array(models))
    third = encode_integers(np.array(symbols), np.array(contexts, np.uint8), signed=True)
    return HEADER.pack(len(first), len(second)) + first + second + third


TWO = StepGroups(np.array([0, 1, 1]), 2)


def test_bytes_made_by_hand_are_read() -> None:
    data = written([0, 192], [7], [5, -3], [7, 7])  # step 192 is 8 * 2^24 units

    assert decode_groups(memoryview(data), TWO).tolist() == [0, 40, -24]


@pytest.mark.parametrize(
    ("data", "claim"),
    [
        (written([256, 192], [0, 0], [1, 1, 1], [0, 0, 0]), "step code"),
        (written([2**50, 192], [0, 0], [1, 1, 1], [0, 0, 0]), "step code"),
        (written([192, 192], [8, 0], [1, 1, 1], [8, 0, 0]), "model"),
        (written([192, 192], [2**40, 0], [1, 1, 1], [0, 0, 0]), "model"),
        (written([192, 192], [0, 0], [1, 1, MAX_ABS_SYMBOL + 1], [0, 0, 0]), "steps"),
        (written([192, 192], [0, 0], [1, 1, -MAX_ABS_SYMBOL - 1], [0, 0, 0]), "steps"),
        (written([192, 192], [0, 0], [1, -(2**54), 1], [0, 0, 0]), "steps"),
    ],
)
def test_numbers_out_of_range_are_rejected(data: bytes, claim: str) -> None:
    with pytest.raises(DamagedDataError, match=claim):
        decode_groups(memoryview(data), TWO)


def test_the_largest_float32_values_are_supported() -> None:
    data = written([1, 255], [0, 0], [MAX_ABS_SYMBOL, MAX_ABS_SYMBOL, -MAX_ABS_SYMBOL], [0, 0, 0])

    np.testing.assert_array_equal(
        decode_groups(memoryview(data), TWO), np.float32([9.0, 1920.0 * MAX_ABS_SYMBOL, -1920.0 * MAX_ABS_SYMBOL])
    )


def test_decoding_takes_little_memory_beside_the_numbers() -> None:
    groups = random_groups(100_000, 100)
    data = encode_groups(quantize_groups(laplace(groups), groups, np.ones(100_000), 1e-2), groups)
    decode_groups(memoryview(data), groups)

    tracemalloc.start()
    decode_groups(memoryview(data), groups)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()

    assert peak < 60 * 100_000

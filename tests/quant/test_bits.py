from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from property_tests import examples

from hyrfpack.quant.bits import pack_bits, unpack_bits
from hyrfpack.quant.errors import DamagedDataError


def pack_bits_by_definition(values: list[int], lengths: list[int]) -> bytes:
    """Pack by the definition: one large integer that holds the first value in its lowest bits."""
    total, place = 0, 0
    for value, length in zip(values, lengths, strict=True):
        total |= (value & (1 << length) - 1) << place
        place += length
    return total.to_bytes((place + 7) // 8, "little")


@given(st.lists(st.tuples(st.integers(0, 2**56 - 1), st.integers(0, 56)), max_size=300))
@examples(150)
def test_pack_bits_follows_the_definition_and_unpack_bits_inverts_it(pairs: list[tuple[int, int]]) -> None:
    values, lengths = [value for value, _ in pairs], [length for _, length in pairs]

    data = pack_bits(np.array(values, np.uint64), np.array(lengths, np.uint8))

    assert data == pack_bits_by_definition(values, lengths)
    unpacked = unpack_bits(data, np.array(lengths, np.uint8))
    assert unpacked.tolist() == [value & (1 << length) - 1 for value, length in pairs]


@pytest.mark.parametrize("top", [0, 1, 7, 56])
def test_200001_values_round_trip(top: int) -> None:
    rng = np.random.default_rng(top)
    lengths = rng.integers(0, top + 1, 200_001).astype(np.uint8)
    values = rng.integers(0, 2**56, 200_001).astype(np.uint64) & ((np.uint64(1) << lengths.astype(np.uint64)) - 1)

    data = pack_bits(values, lengths)

    assert len(data) == (int(lengths.sum()) + 7) // 8
    np.testing.assert_array_equal(unpack_bits(data, lengths), values)


def test_values_of_a_narrower_dtype_are_packed() -> None:
    assert pack_bits(np.array([5, 3], np.uint8), np.array([3, 2], np.uint8)) == bytes([0b11101])


def test_missing_and_extra_bytes_are_refused() -> None:
    lengths = np.array([3, 50, 9], np.uint8)
    data = pack_bits(np.array([5, 2**49, 7], np.uint64), lengths)

    for damaged in (data[:-1], data + b"\0", b""):
        with pytest.raises(DamagedDataError, match="62 bits"):
            unpack_bits(damaged, lengths)


def test_nonzero_padding_bits_are_refused() -> None:
    with pytest.raises(DamagedDataError, match="not zero"):
        unpack_bits(b"\x08", np.array([3], np.uint8))


def test_lengths_of_wrong_shape_dtype_or_size_are_refused() -> None:
    values = np.zeros(2, np.uint64)

    for lengths in (np.zeros(3, np.uint8), np.zeros(2, np.int64), np.zeros((2, 1), np.uint8)):
        with pytest.raises(ValueError, match="one for each"):
            pack_bits(values, lengths)
    with pytest.raises(ValueError, match="at most 56"):
        pack_bits(values, np.array([0, 57], np.uint8))
    with pytest.raises(ValueError, match="at most 56"):
        unpack_bits(bytes(8), np.array([57], np.uint8))

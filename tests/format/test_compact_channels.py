"""Bytes of channels: what hostile ones meet, and sections of several channels."""

from __future__ import annotations

import math
import struct
import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hyrfpack.compress.channels import quantize_channel
from hyrfpack.format.compact.channels import MAX_ABS_CHANNEL_VALUE, decode_channel, encode_channel
from hyrfpack.format.compact.quantized import decode_channels
from hyrfpack.quant import DamagedDataError
from hyrfpack.quant.integers import encode_integers
from hyrfpack.quant.points import LatticePoints
from hyrfpack.quant.steps import decode_step

FIXED_POINT = 2**-24


def one_class(count: int) -> np.ndarray:
    return np.zeros(count, np.uint8)


def smooth(count: int, seed: int = 0) -> np.ndarray:
    return np.cumsum(np.random.default_rng(seed).normal(size=count)) / 10


def noise(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).laplace(size=count)


# Bytes that nobody should have written.

HEADER = struct.Struct("<fBIB")  # mean, weight, bytes of the stream, classes
SMALL_CLASSES = (np.arange(80) % 3).astype(np.uint8)
SMALL = encode_channel(quantize_channel(noise(80), SMALL_CLASSES, np.ones(80), 1e-3), SMALL_CLASSES)


def with_header(**changes: float) -> bytes:
    fields = dict(zip(("mean", "weight", "size", "kinds"), HEADER.unpack_from(SMALL), strict=True))
    return HEADER.pack(*(fields | changes).values()) + SMALL[HEADER.size :]


def test_truncation_at_every_byte_is_refused() -> None:
    for length in range(len(SMALL)):
        with pytest.raises(DamagedDataError):
            decode_channel(memoryview(SMALL)[:length], SMALL_CLASSES)


@pytest.mark.parametrize(
    "changes",
    [
        {"mean": math.nan},
        {"mean": math.inf},
        {"mean": -math.inf},
        {"mean": 4097.0},
        {"weight": 17},
        {"weight": 255},
        {"size": 0},
        {"size": 2**32 - 1},
        {"kinds": 0},
        {"kinds": 2},
        {"kinds": 255},
    ],
    ids=str,
)
def test_headers_that_cannot_be_are_refused(changes: dict[str, float]) -> None:
    tracemalloc.start()
    with pytest.raises(DamagedDataError):
        decode_channel(memoryview(with_header(**changes)), SMALL_CLASSES)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()

    assert peak < 1 << 20


@given(st.data())
@settings(max_examples=200, deadline=None)
def test_damage_is_refused_or_yields_as_many_finite_numbers(data: st.DataObject) -> None:
    damaged = bytearray(SMALL)
    for _ in range(data.draw(st.integers(1, 4))):
        damaged[data.draw(st.integers(0, len(damaged) - 1))] ^= data.draw(st.integers(1, 255))

    try:
        decoded, _ = decode_channel(memoryview(bytes(damaged)), SMALL_CLASSES)
    except DamagedDataError:
        return
    assert decoded.shape == (80,)
    assert np.isfinite(decoded).all() and np.abs(decoded).max() < 1e6


@pytest.mark.parametrize("code", [0, 1, 255])
@pytest.mark.parametrize("sign", [1, -1])
def test_the_largest_differences_allowed_do_not_overflow(code: int, sign: int) -> None:
    step = int(decode_step(code))
    largest = min(int(8 * MAX_ABS_CHANNEL_VALUE / FIXED_POINT) // step, 1 << 30)

    def decode(difference: int) -> np.ndarray:
        stream = encode_integers(np.full(1000, difference), one_class(1000), signed=True)
        data = HEADER.pack(0.0, 16, len(stream), 1) + bytes([code]) + stream
        return decode_channel(memoryview(data), one_class(1000))[0]

    decoded = decode(sign * largest)
    # Each level of the 10 adds a difference to what the mean of its neighbours is.
    assert (sign * decoded >= largest * step * FIXED_POINT - 1e-3).all()
    assert np.abs(decoded).max() <= 11 * largest * step * FIXED_POINT
    with pytest.raises(DamagedDataError, match="beyond"):
        decode(sign * (largest + 1))


def test_differences_far_beyond_32_bits_are_refused() -> None:
    stream = encode_integers(np.array([2**54, -(2**54), 0]), one_class(3), signed=True)
    data = HEADER.pack(0.0, 9, len(stream), 1) + bytes([255]) + stream

    with pytest.raises(DamagedDataError, match="beyond"):
        decode_channel(memoryview(data), one_class(3))


@pytest.mark.parametrize("kinds", [0, 1, 2])
def test_a_class_without_a_step_is_refused(kinds: int) -> None:
    stream = encode_integers(np.zeros(80, np.int64), SMALL_CLASSES, signed=True)
    data = HEADER.pack(0.0, 0, len(stream), kinds) + bytes([99] * kinds) + stream

    with pytest.raises(DamagedDataError, match="header"):
        decode_channel(memoryview(data), SMALL_CLASSES)


def test_decoding_takes_little_memory_beside_the_numbers() -> None:
    classes = (np.arange(100_000) % 6).astype(np.uint8)
    data = encode_channel(quantize_channel(smooth(100_000), classes, np.ones(100_000), 1e-4), classes)
    decode_channel(memoryview(data), classes)

    tracemalloc.start()
    decode_channel(memoryview(data), classes)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()

    assert peak < 80 * 100_000


# Sections of channels.

POINTS = LatticePoints(np.zeros((80, 3), np.int64), SMALL_CLASSES, np.full(3, 5))
TURN = np.array([[0.6, -0.8, 0.0], [0.8, 0.6, 0.0], [0.0, 0.0, 1.0]], "<f4")


def test_three_columns_are_turned_by_the_basis_before_them() -> None:
    parts = [quantize_channel(noise(80, seed), SMALL_CLASSES, np.ones(80), 1e-4) for seed in range(3)]
    data = TURN.tobytes() + b"".join(encode_channel(part, SMALL_CLASSES) for part in parts)

    decoded = decode_channels(memoryview(data), POINTS, 3)

    expected = np.stack([part.values for part in parts], axis=1) @ TURN.astype(np.float64).T
    assert decoded.dtype == np.float32
    np.testing.assert_allclose(decoded, expected, rtol=0, atol=1e-6)


def test_one_column_has_no_basis() -> None:
    decoded = decode_channels(memoryview(SMALL), POINTS, 1)

    np.testing.assert_array_equal(decoded[:, 0], decode_channel(memoryview(SMALL), SMALL_CLASSES)[0].astype(np.float32))


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf, 1.1, -3e38])
@pytest.mark.parametrize("place", [0, 4, 8])
def test_a_basis_that_cannot_be_is_refused(place: int, wrong: float) -> None:
    basis = TURN.copy()
    basis.flat[place] = wrong

    with pytest.raises(DamagedDataError, match="basis"):
        decode_channels(memoryview(basis.tobytes() + 3 * SMALL), POINTS, 3)


def test_sections_too_short_or_too_long_are_refused() -> None:
    three = TURN.tobytes() + 3 * SMALL

    for data, columns in ((three, 3), (SMALL, 1)):
        for length in range(len(data)):
            with pytest.raises(DamagedDataError):
                decode_channels(memoryview(data)[:length], POINTS, columns)
        with pytest.raises(DamagedDataError, match="follow"):
            decode_channels(memoryview(data + b"\0"), POINTS, columns)

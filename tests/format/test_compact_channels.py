"""Channels of profile compact: hostile bytes are refused, and sections hold one or three channels."""

from __future__ import annotations

import math
import struct
import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from property_tests import examples

from hyrfpack.compress.channels import quantize_channel
from hyrfpack.format.compact.channels import MAX_ABS_CHANNEL_VALUE, decode_channel, encode_channel
from hyrfpack.format.compact.quantized import decode_channels
from hyrfpack.quant import DamagedDataError
from hyrfpack.quant.integers import encode_integers
from hyrfpack.quant.points import LatticePoints
from hyrfpack.quant.steps import decode_step

FIXED_POINT_UNIT = 2**-24


def single_class(count: int) -> np.ndarray:
    return np.zeros(count, np.uint8)


def smooth_values(count: int, seed: int = 0) -> np.ndarray:
    return np.cumsum(np.random.default_rng(seed).normal(size=count)) / 10


def laplace_values(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).laplace(size=count)


# Hostile bytes.

HEADER_STRUCT = struct.Struct("<fBIB")  # mean, weight, stream bytes, number of classes
SAMPLE_CLASSES = (np.arange(80) % 3).astype(np.uint8)
SAMPLE_CHANNEL = encode_channel(quantize_channel(laplace_values(80), SAMPLE_CLASSES, np.ones(80), 1e-3), SAMPLE_CLASSES)


def sample_with_header(**changes: float) -> bytes:
    fields = dict(zip(("mean", "weight", "size", "kinds"), HEADER_STRUCT.unpack_from(SAMPLE_CHANNEL), strict=True))
    return HEADER_STRUCT.pack(*(fields | changes).values()) + SAMPLE_CHANNEL[HEADER_STRUCT.size :]


def test_truncation_at_every_byte_is_refused() -> None:
    for length in range(len(SAMPLE_CHANNEL)):
        with pytest.raises(DamagedDataError):
            decode_channel(memoryview(SAMPLE_CHANNEL)[:length], SAMPLE_CLASSES)


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
def test_invalid_headers_are_refused_in_little_memory(changes: dict[str, float]) -> None:
    tracemalloc.start()
    with pytest.raises(DamagedDataError):
        decode_channel(memoryview(sample_with_header(**changes)), SAMPLE_CLASSES)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()

    assert peak < 1 << 20


@given(st.data())
@examples(200)
def test_damaged_data_is_refused_or_decodes_to_finite_values(data: st.DataObject) -> None:
    damaged = bytearray(SAMPLE_CHANNEL)
    for _ in range(data.draw(st.integers(1, 4))):
        damaged[data.draw(st.integers(0, len(damaged) - 1))] ^= data.draw(st.integers(1, 255))

    try:
        decoded, _ = decode_channel(memoryview(bytes(damaged)), SAMPLE_CLASSES)
    except DamagedDataError:
        return
    assert decoded.shape == (80,)
    assert np.isfinite(decoded).all() and np.abs(decoded).max() < 1e6


@pytest.mark.parametrize("code", [0, 1, 255])
@pytest.mark.parametrize("sign", [1, -1])
def test_the_largest_allowed_residuals_do_not_overflow(code: int, sign: int) -> None:
    step = int(decode_step(code))
    largest = min(int(8 * MAX_ABS_CHANNEL_VALUE / FIXED_POINT_UNIT) // step, 1 << 30)

    def decode(difference: int) -> np.ndarray:
        stream = encode_integers(np.full(1000, difference), single_class(1000), signed=True)
        data = HEADER_STRUCT.pack(0.0, 16, len(stream), 1) + bytes([code]) + stream
        return decode_channel(memoryview(data), single_class(1000))[0]

    decoded = decode(sign * largest)
    # Each of the 10 levels adds one residual to the mean of its neighbours.
    assert (sign * decoded >= largest * step * FIXED_POINT_UNIT - 1e-3).all()
    assert np.abs(decoded).max() <= 11 * largest * step * FIXED_POINT_UNIT
    with pytest.raises(DamagedDataError, match="beyond"):
        decode(sign * (largest + 1))


def test_residuals_beyond_32_bits_are_refused() -> None:
    stream = encode_integers(np.array([2**54, -(2**54), 0]), single_class(3), signed=True)
    data = HEADER_STRUCT.pack(0.0, 9, len(stream), 1) + bytes([255]) + stream

    with pytest.raises(DamagedDataError, match="beyond"):
        decode_channel(memoryview(data), single_class(3))


@pytest.mark.parametrize("kinds", [0, 1, 2])
def test_a_class_without_a_step_is_refused(kinds: int) -> None:
    stream = encode_integers(np.zeros(80, np.int64), SAMPLE_CLASSES, signed=True)
    data = HEADER_STRUCT.pack(0.0, 0, len(stream), kinds) + bytes([99] * kinds) + stream

    with pytest.raises(DamagedDataError, match="header"):
        decode_channel(memoryview(data), SAMPLE_CLASSES)


def test_decoding_takes_at_most_80_bytes_per_value() -> None:
    classes = (np.arange(100_000) % 6).astype(np.uint8)
    data = encode_channel(quantize_channel(smooth_values(100_000), classes, np.ones(100_000), 1e-4), classes)
    decode_channel(memoryview(data), classes)

    tracemalloc.start()
    decode_channel(memoryview(data), classes)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()

    assert peak < 80 * 100_000


# Sections of one or three channels.

SAMPLE_POINTS = LatticePoints(np.zeros((80, 3), np.int64), SAMPLE_CLASSES, np.full(3, 5))
ROTATION_BASIS = np.array([[0.6, -0.8, 0.0], [0.8, 0.6, 0.0], [0.0, 0.0, 1.0]], "<f4")


def test_three_columns_are_rotated_by_the_stored_basis() -> None:
    parts = [quantize_channel(laplace_values(80, seed), SAMPLE_CLASSES, np.ones(80), 1e-4) for seed in range(3)]
    data = ROTATION_BASIS.tobytes() + b"".join(encode_channel(part, SAMPLE_CLASSES) for part in parts)

    decoded = decode_channels(memoryview(data), SAMPLE_POINTS, 3)

    expected = np.stack([part.values for part in parts], axis=1) @ ROTATION_BASIS.astype(np.float64).T
    assert decoded.dtype == np.float32
    np.testing.assert_allclose(decoded, expected, rtol=0, atol=1e-6)


def test_one_column_is_stored_without_a_basis() -> None:
    decoded = decode_channels(memoryview(SAMPLE_CHANNEL), SAMPLE_POINTS, 1)

    np.testing.assert_array_equal(
        decoded[:, 0], decode_channel(memoryview(SAMPLE_CHANNEL), SAMPLE_CLASSES)[0].astype(np.float32)
    )


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf, 1.1, -3e38])
@pytest.mark.parametrize("place", [0, 4, 8])
def test_an_invalid_basis_is_refused(place: int, wrong: float) -> None:
    basis = ROTATION_BASIS.copy()
    basis.flat[place] = wrong

    with pytest.raises(DamagedDataError, match="basis"):
        decode_channels(memoryview(basis.tobytes() + 3 * SAMPLE_CHANNEL), SAMPLE_POINTS, 3)


def test_truncated_and_too_long_sections_are_refused() -> None:
    three = ROTATION_BASIS.tobytes() + 3 * SAMPLE_CHANNEL

    for data, columns in ((three, 3), (SAMPLE_CHANNEL, 1)):
        for length in range(len(data)):
            with pytest.raises(DamagedDataError):
                decode_channels(memoryview(data)[:length], SAMPLE_POINTS, columns)
        with pytest.raises(DamagedDataError, match="follow"):
            decode_channels(memoryview(data + b"\0"), SAMPLE_POINTS, columns)

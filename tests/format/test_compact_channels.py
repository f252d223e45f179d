"""One number for each Gaussian to bytes and back: bounds, bits, and what hostile bytes meet."""

from __future__ import annotations

import math
import struct
import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hyrfpack.format.compact import channels
from hyrfpack.format.compact.channels import LIMIT, Channel, decode_channel, encode_channel, quantize_channel
from hyrfpack.format.compact.sections import decode_channels
from hyrfpack.quant import DamagedDataError
from hyrfpack.quant.integers import encode_integers
from hyrfpack.quant.points import Points
from hyrfpack.quant.steps import step_of

FIXED_POINT = 2**-24


def one_class(count: int) -> np.ndarray:
    return np.zeros(count, np.uint8)


def step_for(error: float, sensitivity: float = 1.0) -> float:
    """D such that the step is about sqrt(12 D / s) = `error` sqrt(12)."""
    return error**2 * sensitivity


def check_round_trip(channel: Channel, classes: np.ndarray) -> None:
    data = encode_channel(channel, classes)

    decoded, rest = decode_channel(memoryview(data + b"next"), classes)

    np.testing.assert_array_equal(decoded, channel.values)
    assert bytes(rest) == b"next"


def smooth(count: int, seed: int = 0) -> np.ndarray:
    return np.cumsum(np.random.default_rng(seed).normal(size=count)) / 10


def noise(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).laplace(size=count)


CASES = {
    "none": np.zeros(0),
    "one": np.array([-3.25]),
    "constant": np.full(500, 1.7),
    "noise": noise(700),
    "smooth": smooth(700),
    "outliers": np.where(np.arange(700) % 97, noise(700), 4000.0),
    "out of range": np.where(np.arange(64) % 2, 1e9, -1e30),
    "tiny": 1e-9 * noise(100),
    "alternating ends": np.where(np.arange(64) % 2, LIMIT, -LIMIT),
}


@pytest.mark.parametrize("reach", [0, 1, 4])
@pytest.mark.parametrize("kinds", [1, 6])
@pytest.mark.parametrize("name", CASES)
def test_channels_round_trip(name: str, kinds: int, reach: int) -> None:
    values = CASES[name]
    classes = (np.arange(len(values)) * 7 % kinds).astype(np.uint8)
    sensitivity = 10.0 ** -classes.astype(float)

    for distortion in (1e-10, 1e-4, 1e6):
        channel = quantize_channel(values, classes, sensitivity, distortion, reach=reach)

        check_round_trip(channel, classes)


@given(st.data())
@settings(max_examples=100, deadline=None)
def test_any_channel_round_trips_within_its_bound(data: st.DataObject) -> None:
    values = np.array(data.draw(st.lists(st.floats(-50, 50) | st.sampled_from([0.0, 1.0]), max_size=60)))
    kinds, reach = data.draw(st.integers(1, 16)), data.draw(st.sampled_from([0, 1, 4]))
    classes = np.random.default_rng(len(values)).integers(kinds, size=len(values)).astype(np.uint8)
    sensitivity = 10.0 ** data.draw(st.floats(-12, 3)) * (1.0 + classes)
    distortion = 10.0 ** data.draw(st.floats(-13, 6))

    channel = quantize_channel(values, classes, sensitivity, distortion, reach=reach)

    check_round_trip(channel, classes)
    steps = step_of(channel.codes)[classes] * FIXED_POINT
    assert (np.abs(channel.values - values) <= (0.5 + reach) * steps + FIXED_POINT).all()


def test_many_numbers_round_trip() -> None:
    values, classes = smooth(300_000), (np.arange(300_000) % 6).astype(np.uint8)

    channel = quantize_channel(values, classes, 10.0 ** -classes.astype(float), 1e-4)

    check_round_trip(channel, classes)


@pytest.mark.parametrize("half_range", [600.0, LIMIT])
def test_a_wide_range_in_the_finest_steps_round_trips(half_range: float) -> None:
    channel = quantize_channel(np.array([-half_range, half_range]), one_class(2), np.full(2, 1e6), 1e-12)

    check_round_trip(channel, one_class(2))


@pytest.mark.parametrize("values", [noise(3000), smooth(3000), 1000 + noise(3000)], ids=["noise", "smooth", "far"])
@pytest.mark.parametrize("error", [1e-6, 1e-3, 0.3, 100.0])
def test_without_reach_the_error_is_half_a_step_at_most(values: np.ndarray, error: float) -> None:
    classes = (np.arange(len(values)) % 3).astype(np.uint8)
    sensitivity = np.array([1.0, 0.1, 0.01])[classes]

    channel = quantize_channel(values, classes, sensitivity, step_for(error), reach=0)

    steps = step_of(channel.codes)[classes] * FIXED_POINT
    assert (np.abs(channel.values - values) <= steps / 2 + FIXED_POINT / 2 + 1e-12).all()


def test_every_number_adds_the_error_it_may() -> None:
    values = noise(60_000) * 10
    classes = (np.arange(len(values)) % 6).astype(np.uint8)
    sensitivity = 8.0 ** -classes.astype(float)

    channel = quantize_channel(values, classes, sensitivity, 1e-5, reach=0)

    for kind in range(6):
        of_class = classes == kind
        added = (sensitivity * (channel.values - values) ** 2)[of_class].mean()
        assert 0.85 < added / 1e-5 < 1.15  # a step is at most 1/16 from the one asked for


def test_numbers_beyond_the_limit_are_cut() -> None:
    channel = quantize_channel(np.array([1e30, -np.inf, 0.0, 4096.5]), one_class(4), np.ones(4), 1e-8, reach=0)

    np.testing.assert_allclose(channel.values, [LIMIT, -LIMIT, 0, LIMIT], atol=1e-3)


def measured_cost(channel: Channel, values: np.ndarray, classes: np.ndarray, weights, distortion: float) -> float:
    """Error and bits on one scale, by the bytes that come out: a bit is worth 2 ln 2 D."""
    error = float((weights * (channel.values - values) ** 2).sum())
    return error + 2 * math.log(2) * distortion * 8 * len(encode_channel(channel, classes))


@pytest.mark.parametrize(
    ("signal", "error"),
    [
        *[(noise, error) for error in (0.1, 0.3, 1.0, 2.0)],
        (smooth, 0.1),
    ],
)
def test_reach_costs_less_in_error_and_bytes_together(signal, error: float) -> None:
    values = signal(20_000)
    classes = (np.arange(len(values)) % 2).astype(np.uint8)
    weights, distortion = np.array([1.0, 0.5])[classes], step_for(error)

    near, far = (quantize_channel(values, classes, weights, distortion, reach=reach) for reach in (0, 1))

    costs = [measured_cost(channel, values, classes, weights, distortion) for channel in (near, far)]
    assert costs[1] < costs[0]


@pytest.mark.parametrize("error", [2.0, 4.0])
def test_reach_never_costs_more_where_coarse_numbers_are_what_finer_ones_are_predicted_by(error: float) -> None:
    values = smooth(20_000)
    classes = (np.arange(len(values)) % 2).astype(np.uint8)
    weights, distortion = np.array([1.0, 0.5])[classes], step_for(error)

    near, far = (quantize_channel(values, classes, weights, distortion, reach=reach) for reach in (0, 1))

    costs = [measured_cost(channel, values, classes, weights, distortion) for channel in (near, far)]
    assert costs[1] <= costs[0]


def test_smooth_channels_are_predicted_and_noise_is_not() -> None:
    chosen = {
        signal: quantize_channel(signal(5000), one_class(5000), np.ones(5000), step_for(0.01)).weight
        for signal in (noise, smooth)
    }

    assert chosen[noise] == 0 < chosen[smooth]


def test_prediction_makes_smooth_channels_smaller(monkeypatch: pytest.MonkeyPatch) -> None:
    values, classes = smooth(5000), one_class(5000)

    def size() -> int:
        return len(encode_channel(quantize_channel(values, classes, np.ones(5000), step_for(0.01)), classes))

    predicted = size()
    monkeypatch.setattr(channels, "WEIGHTS", (0,))

    assert predicted < 0.85 * size()


def test_an_error_of_ones_own_decides_what_is_cheapest() -> None:
    """Numbers below 0 do not matter here, so they all become the most common symbol within reach."""
    values = noise(4000)

    def error(places: np.ndarray, candidates: np.ndarray) -> np.ndarray:
        return np.where(values[places] < 0, 0.0, (candidates - values[places]) ** 2)

    classes, ones = one_class(4000), np.ones(4000)
    counted = quantize_channel(values, classes, ones, step_for(0.1), error, reach=4)
    plain = quantize_channel(values, classes, ones, step_for(0.1), reach=4)

    assert len(encode_channel(counted, classes)) < 0.8 * len(encode_channel(plain, classes))
    off = np.abs(counted.values - values)
    assert off[values >= 0].mean() < off[values < 0].mean() / 2


def test_the_same_numbers_give_the_same_bytes() -> None:
    values, classes = smooth(3000), (np.arange(3000) % 4).astype(np.uint8)

    written = {encode_channel(quantize_channel(values.copy(), classes, np.ones(3000), 1e-4), classes) for _ in range(2)}

    assert len(written) == 1


def test_a_silent_channel_takes_hardly_any_bytes() -> None:
    channel = quantize_channel(np.full(100_000, -2.5), one_class(100_000), np.ones(100_000), 1e-6)

    assert len(encode_channel(channel, one_class(100_000))) < 20
    np.testing.assert_allclose(channel.values, -2.5, atol=1e-3)


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
    step = int(step_of(code))
    largest = min(int(8 * LIMIT / FIXED_POINT) // step, 1 << 30)

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

POINTS = Points(np.zeros((80, 3), np.int64), SMALL_CLASSES, np.full(3, 5))
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

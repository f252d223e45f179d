"""Channels of one value per Gaussian round-trip within their error bounds and with few bits."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from property_tests import examples

from hyrfpack.compress import channels
from hyrfpack.compress.channels import ErrorModel, quantize_channel
from hyrfpack.format.compact.channels import MAX_ABS_CHANNEL_VALUE, Channel, decode_channel, encode_channel
from hyrfpack.quant.steps import decode_step

FIXED_POINT_UNIT = 2**-24


def single_class(count: int) -> np.ndarray:
    return np.zeros(count, np.uint8)


def distortion_for_error(error: float, sensitivity: float = 1.0) -> float:
    """Return the distortion D for which the step sqrt(12 D / s) is about `error` sqrt(12)."""
    return error**2 * sensitivity


def check_round_trip(channel: Channel, classes: np.ndarray) -> None:
    data = encode_channel(channel, classes)

    decoded, rest = decode_channel(memoryview(data + b"next"), classes)

    np.testing.assert_array_equal(decoded, channel.values)
    assert bytes(rest) == b"next"


def smooth_values(count: int, seed: int = 0) -> np.ndarray:
    return np.cumsum(np.random.default_rng(seed).normal(size=count)) / 10


def laplace_values(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).laplace(size=count)


HARD_CASES = {
    "none": np.zeros(0),
    "one": np.array([-3.25]),
    "constant": np.full(500, 1.7),
    "noise": laplace_values(700),
    "smooth": smooth_values(700),
    "outliers": np.where(np.arange(700) % 97, laplace_values(700), 4000.0),
    "out of range": np.where(np.arange(64) % 2, 1e9, -1e30),
    "tiny": 1e-9 * laplace_values(100),
    "alternating ends": np.where(np.arange(64) % 2, MAX_ABS_CHANNEL_VALUE, -MAX_ABS_CHANNEL_VALUE),
}


@pytest.mark.parametrize("reach", [0, 1, 4])
@pytest.mark.parametrize("kinds", [1, 6])
@pytest.mark.parametrize("name", HARD_CASES)
def test_channels_round_trip(name: str, kinds: int, reach: int) -> None:
    values = HARD_CASES[name]
    classes = (np.arange(len(values)) * 7 % kinds).astype(np.uint8)
    sensitivity = 10.0 ** -classes.astype(float)

    for distortion in (1e-10, 1e-4, 1e6):
        channel = quantize_channel(values, classes, sensitivity, distortion, reach=reach)

        check_round_trip(channel, classes)


@given(st.data())
@examples(100)
def test_any_channel_round_trips_within_its_bound(data: st.DataObject) -> None:
    values = np.array(data.draw(st.lists(st.floats(-50, 50) | st.sampled_from([0.0, 1.0]), max_size=60)))
    kinds, reach = data.draw(st.integers(1, 16)), data.draw(st.sampled_from([0, 1, 4]))
    classes = np.random.default_rng(len(values)).integers(kinds, size=len(values)).astype(np.uint8)
    sensitivity = 10.0 ** data.draw(st.floats(-12, 3)) * (1.0 + classes)
    distortion = 10.0 ** data.draw(st.floats(-13, 6))

    channel = quantize_channel(values, classes, sensitivity, distortion, reach=reach)

    check_round_trip(channel, classes)
    steps = decode_step(channel.codes)[classes] * FIXED_POINT_UNIT
    assert (np.abs(channel.values - values) <= (0.5 + reach) * steps + FIXED_POINT_UNIT).all()


def test_many_values_round_trip() -> None:
    values, classes = smooth_values(300_000), (np.arange(300_000) % 6).astype(np.uint8)

    channel = quantize_channel(values, classes, 10.0 ** -classes.astype(float), 1e-4)

    check_round_trip(channel, classes)


@pytest.mark.parametrize("half_range", [600.0, MAX_ABS_CHANNEL_VALUE])
def test_a_wide_range_with_the_finest_steps_round_trips(half_range: float) -> None:
    channel = quantize_channel(np.array([-half_range, half_range]), single_class(2), np.full(2, 1e6), 1e-12)

    check_round_trip(channel, single_class(2))


@pytest.mark.parametrize(
    "values", [laplace_values(3000), smooth_values(3000), 1000 + laplace_values(3000)], ids=["noise", "smooth", "far"]
)
@pytest.mark.parametrize("error", [1e-6, 1e-3, 0.3, 100.0])
def test_with_reach_0_the_error_is_at_most_half_a_step(values: np.ndarray, error: float) -> None:
    classes = (np.arange(len(values)) % 3).astype(np.uint8)
    sensitivity = np.array([1.0, 0.1, 0.01])[classes]

    channel = quantize_channel(values, classes, sensitivity, distortion_for_error(error), reach=0)

    steps = decode_step(channel.codes)[classes] * FIXED_POINT_UNIT
    assert (np.abs(channel.values - values) <= steps / 2 + FIXED_POINT_UNIT / 2 + 1e-12).all()


def test_every_class_adds_its_allowed_distortion() -> None:
    values = laplace_values(60_000) * 10
    classes = (np.arange(len(values)) % 6).astype(np.uint8)
    sensitivity = 8.0 ** -classes.astype(float)

    channel = quantize_channel(values, classes, sensitivity, 1e-5, reach=0)

    for kind in range(6):
        of_class = classes == kind
        added = (sensitivity * (channel.values - values) ** 2)[of_class].mean()
        assert 0.85 < added / 1e-5 < 1.15  # a step differs from the requested one by at most 1/16


def test_values_beyond_the_limit_are_clipped() -> None:
    channel = quantize_channel(np.array([1e30, -np.inf, 0.0, 4096.5]), single_class(4), np.ones(4), 1e-8, reach=0)

    np.testing.assert_allclose(
        channel.values, [MAX_ABS_CHANNEL_VALUE, -MAX_ABS_CHANNEL_VALUE, 0, MAX_ABS_CHANNEL_VALUE], atol=1e-3
    )


def measured_cost(channel: Channel, values: np.ndarray, classes: np.ndarray, weights, distortion: float) -> float:
    """Return the rate-distortion cost of the encoded bytes, in which a bit costs 2 ln 2 D."""
    error = float((weights * (channel.values - values) ** 2).sum())
    return error + 2 * math.log(2) * distortion * 8 * len(encode_channel(channel, classes))


@pytest.mark.parametrize(
    ("signal", "error"),
    [
        *[(laplace_values, error) for error in (0.1, 0.3, 1.0, 2.0)],
        (smooth_values, 0.1),
    ],
)
def test_reach_lowers_the_rate_distortion_cost(signal, error: float) -> None:
    values = signal(20_000)
    classes = (np.arange(len(values)) % 2).astype(np.uint8)
    weights, distortion = np.array([1.0, 0.5])[classes], distortion_for_error(error)

    near, far = (quantize_channel(values, classes, weights, distortion, reach=reach) for reach in (0, 1))

    costs = [measured_cost(channel, values, classes, weights, distortion) for channel in (near, far)]
    assert costs[1] < costs[0]


@pytest.mark.parametrize("error", [2.0, 4.0])
def test_reach_does_not_raise_the_cost_of_predicted_values(error: float) -> None:
    values = smooth_values(20_000)
    classes = (np.arange(len(values)) % 2).astype(np.uint8)
    weights, distortion = np.array([1.0, 0.5])[classes], distortion_for_error(error)

    near, far = (quantize_channel(values, classes, weights, distortion, reach=reach) for reach in (0, 1))

    costs = [measured_cost(channel, values, classes, weights, distortion) for channel in (near, far)]
    assert costs[1] <= costs[0]


def test_smooth_channels_are_predicted_and_noise_is_not() -> None:
    chosen = {
        signal: quantize_channel(signal(5000), single_class(5000), np.ones(5000), distortion_for_error(0.01)).weight
        for signal in (laplace_values, smooth_values)
    }

    assert chosen[laplace_values] == 0 < chosen[smooth_values]


def test_prediction_makes_smooth_channels_smaller(monkeypatch: pytest.MonkeyPatch) -> None:
    values, classes = smooth_values(5000), single_class(5000)

    def size() -> int:
        return len(
            encode_channel(quantize_channel(values, classes, np.ones(5000), distortion_for_error(0.01)), classes)
        )

    predicted = size()
    monkeypatch.setattr(channels, "PREDICTION_WEIGHTS_SIXTEENTHS", (0,))

    assert predicted < 0.85 * size()


def test_an_error_model_selects_the_cheapest_symbols() -> None:
    """Values below 0 have no error here, so they all become the most common symbol within reach."""
    values = laplace_values(4000)

    error = ErrorModel(values, np.where(values < 0, 0.0, 1.0))
    classes, ones = single_class(4000), np.ones(4000)
    counted = quantize_channel(values, classes, ones, distortion_for_error(0.1), error, reach=4)
    plain = quantize_channel(values, classes, ones, distortion_for_error(0.1), reach=4)

    assert len(encode_channel(counted, classes)) < 0.8 * len(encode_channel(plain, classes))
    off = np.abs(counted.values - values)
    assert off[values >= 0].mean() < off[values < 0].mean() / 2


@pytest.mark.parametrize("reach", [0, 1, 4])
@pytest.mark.parametrize("saturates", [False, True])
@pytest.mark.parametrize("name", HARD_CASES)
def test_compiled_and_plain_choices_are_the_same(name: str, saturates: bool, reach: int) -> None:
    values = HARD_CASES[name]
    rng = np.random.default_rng(0)
    classes = (np.arange(len(values)) * 7 % 3).astype(np.uint8)
    weights = 10.0 ** -classes.astype(float) * rng.uniform(0.5, 2, size=len(values))
    error = ErrorModel(rng.uniform(size=len(values)), weights, rng.normal(size=len(values))) if saturates else None

    for distortion in (1e-10, 1e-4, 1e-1, 1e6):
        compiled, plain = (
            quantize_channel(values, classes, weights, distortion, error, reach, implementation)
            for implementation in ("cpu", "numpy")
        )

        assert (compiled.mean, compiled.weight) == (plain.mean, plain.weight)
        np.testing.assert_array_equal(compiled.codes, plain.codes)
        np.testing.assert_array_equal(compiled.residuals, plain.residuals)
        np.testing.assert_array_equal(compiled.values, plain.values)


def test_encoding_is_deterministic() -> None:
    values, classes = smooth_values(3000), (np.arange(3000) % 4).astype(np.uint8)

    written = {encode_channel(quantize_channel(values.copy(), classes, np.ones(3000), 1e-4), classes) for _ in range(2)}

    assert len(written) == 1


def test_a_channel_without_sensitivity_takes_few_bytes() -> None:
    channel = quantize_channel(np.full(100_000, -2.5), single_class(100_000), np.ones(100_000), 1e-6)

    assert len(encode_channel(channel, single_class(100_000))) < 20
    np.testing.assert_allclose(channel.values, -2.5, atol=1e-3)

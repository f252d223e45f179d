"""Values in step groups round-trip within their error bounds, and symbols minimise rate-distortion cost."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from property_tests import examples

from hyrfpack.compress.groups import quantize_groups
from hyrfpack.compress.rate_distortion import choose_step_codes, choose_symbols, estimate_code_bits
from hyrfpack.format.compact.groups import (
    ENTROPY_MODEL_COUNT,
    GroupSymbols,
    StepGroups,
    decode_groups,
    encode_groups,
)
from hyrfpack.quant.steps import ALL_ZERO_CODE, FIXED_POINT_ONE, MAX_ABS_SYMBOL, decode_step


def random_groups(count: int, groups: int, seed: int = 0) -> StepGroups:
    return StepGroups(np.random.default_rng(seed).integers(groups, size=count), groups)


def laplace_values(groups: StepGroups, seed: int = 1) -> np.ndarray:
    """Return Laplace-distributed values whose scale grows from group to group."""
    return np.random.default_rng(seed).laplace(size=len(groups.index)) * 1.3 ** (groups.index % 10)


def check_round_trip(chosen: GroupSymbols, groups: StepGroups) -> bytes:
    data = encode_groups(chosen, groups)

    decoded = decode_groups(memoryview(data), groups)

    assert decoded.dtype == np.float32
    np.testing.assert_array_equal(decoded, chosen.values)
    return data


@pytest.mark.parametrize("reach", [0, 1])
@pytest.mark.parametrize("count", [0, 1, 2, 1000])
@pytest.mark.parametrize("number", [1, 5, 300])
def test_groups_round_trip(count: int, number: int, reach: int) -> None:
    groups = random_groups(count, number)
    values = laplace_values(groups) if number < 300 else np.random.default_rng(2).normal(size=count)

    for distortion in (1e-9, 1e-2, 1e9):
        check_round_trip(quantize_groups(values, groups, np.ones(count), distortion, reach), groups)


@given(st.data())
@examples(100)
def test_any_groups_round_trip_within_their_bound(data: st.DataObject) -> None:
    values = np.array(data.draw(st.lists(st.floats(-6, 6) | st.just(0.0), max_size=60)))
    groups = random_groups(len(values), data.draw(st.integers(1, 20)), len(values))
    sensitivity = np.array(data.draw(st.lists(st.floats(1e-9, 1e3), min_size=len(values), max_size=len(values))))
    distortion, reach = 10.0 ** data.draw(st.floats(-14, 6)), data.draw(st.integers(0, 1))

    chosen = quantize_groups(values, groups, sensitivity, distortion, reach)

    check_round_trip(chosen, groups)
    off = np.abs(chosen.values - values)
    steps = decode_step(chosen.codes)[groups.index] / FIXED_POINT_ONE
    coded = chosen.codes[groups.index] != ALL_ZERO_CODE
    assert (off <= (0.5 + reach) * steps + np.abs(values) * 2**-23)[coded].all()
    assert (chosen.values[~coded] == 0).all()


def test_many_values_round_trip() -> None:
    groups = random_groups(300_000, 100)

    check_round_trip(quantize_groups(laplace_values(groups), groups, np.ones(300_000), 1e-2), groups)


@pytest.mark.parametrize("error", [1e-5, 1e-3, 0.1, 10.0])
def test_with_reach_0_the_error_is_at_most_half_a_step(error: float) -> None:
    groups = random_groups(5000, 10)
    values = laplace_values(groups)

    chosen = quantize_groups(values, groups, np.ones(5000), error**2, reach=0)

    steps = decode_step(choose_step_codes(np.ones(1), error**2)) / FIXED_POINT_ONE
    assert (np.abs(chosen.values - values) <= steps / 2 + np.abs(values) * 2**-23).all()


def test_every_group_adds_its_allowed_distortion() -> None:
    groups = random_groups(60_000, 6)
    sensitivity = 8.0 ** -groups.index.astype(float)
    values = 100 * np.random.default_rng(1).normal(size=60_000)

    chosen = quantize_groups(values, groups, sensitivity, 1e-4, reach=0)

    for group in range(6):
        added = (sensitivity * (chosen.values - values) ** 2)[groups.index == group].mean()
        assert 0.85 < added / 1e-4 < 1.15  # a step differs from the requested one by at most 1/16


def test_groups_without_sensitivity_become_zeros_without_symbols() -> None:
    groups = random_groups(2000, 4)
    values, seen = laplace_values(groups), np.where(groups.index == 2, 0.0, 1.0)
    kept = groups.index != 2
    without = StepGroups(groups.index[kept], 4)

    chosen = quantize_groups(values, groups, seen, 1e-2)

    assert chosen.codes[2] == ALL_ZERO_CODE and (chosen.codes[[0, 1, 3]] != ALL_ZERO_CODE).all()
    assert (chosen.values[~kept] == 0).all()
    assert check_round_trip(chosen, groups) == encode_groups(
        quantize_groups(values[kept], without, np.ones(kept.sum()), 1e-2), without
    )


def test_groups_of_zeros_take_few_bytes() -> None:
    groups = random_groups(100_000, 512)

    for values in (np.zeros(100_000), np.full(100_000, 1e-6)):
        chosen = quantize_groups(values, groups, np.ones(100_000), 1.0)
        assert (chosen.codes == ALL_ZERO_CODE).all()
        assert len(check_round_trip(chosen, groups)) < 16


def test_a_group_without_members_is_not_coded() -> None:
    chosen = quantize_groups(np.array([1.0, 2.0]), StepGroups(np.array([3, 3]), 5), np.ones(2), 1e-4)

    assert np.flatnonzero(chosen.codes).tolist() == [3]


def test_values_beyond_the_largest_symbol_are_clipped() -> None:
    groups = StepGroups(np.zeros(3, np.int64), 1)

    chosen = quantize_groups(np.array([1e30, -1e30, 1.0]), groups, np.ones(3), 1e-6, reach=0)

    assert chosen.symbols[:2].tolist() == [MAX_ABS_SYMBOL, -MAX_ABS_SYMBOL]
    check_round_trip(chosen, groups)


@pytest.mark.parametrize(("value", "distortion"), [(1e6, 1e-6), (10.0, 1e-16)])
def test_values_beyond_the_largest_symbol_are_clipped_with_reach_too(value: float, distortion: float) -> None:
    groups = StepGroups(np.zeros(2, np.int64), 1)

    check_round_trip(quantize_groups(np.array([value, 1.0]), groups, np.ones(2), distortion), groups)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("reach", [0, 1, 3])
@pytest.mark.parametrize("count", [0, 1, 5000, 70_000])
def test_compiled_and_plain_choices_are_the_same(count: int, reach: int, dtype: type) -> None:
    groups = random_groups(count, 20)
    groups = StepGroups(groups.index.astype(np.uint16), groups.count)
    values = laplace_values(groups).astype(dtype)
    sensitivity = np.where(groups.index == 3, 0.0, np.random.default_rng(2).exponential(size=count))

    for distortion in (1e-16, 1e-2, 1.0, 1e9):
        compiled, plain = (
            quantize_groups(values, groups, sensitivity, distortion, reach, implementation)
            for implementation in ("cpu", "numpy")
        )

        for name in ("codes", "models", "symbols", "values"):
            np.testing.assert_array_equal(getattr(compiled, name), getattr(plain, name))


def test_encoding_is_deterministic() -> None:
    groups = random_groups(3000, 30)
    values = laplace_values(groups)

    written = {encode_groups(quantize_groups(values.copy(), groups, np.ones(3000), 1e-3), groups) for _ in range(2)}

    assert len(written) == 1


def test_groups_of_similar_spread_share_a_model() -> None:
    """A single model would code the symbols of wide and narrow groups with the same bits."""
    groups = random_groups(40_000, 2)
    scale = np.array([0.2, 20.0])[groups.index]
    values = scale * np.random.default_rng(5).laplace(size=40_000)
    chosen = quantize_groups(values, groups, np.ones(40_000), 0.1, reach=0)
    pooled = GroupSymbols(chosen.codes, np.zeros(2, np.uint8), chosen.symbols, chosen.values)

    sizes = [len(check_round_trip(symbols, groups)) for symbols in (chosen, pooled)]

    assert chosen.models[0] < chosen.models[1] < ENTROPY_MODEL_COUNT
    assert sizes[0] < 0.9 * sizes[1]


# Choice of symbols.


@given(st.lists(st.integers(-5000, 5000) | st.integers(-3, 3), max_size=60), st.integers(1, 4), st.integers(1, 4))
@examples(80)
def test_symbol_bits_satisfy_krafts_equality(symbols: list[int], kinds: int, reach: int) -> None:
    classes = np.arange(len(symbols)) % kinds

    bits, least = estimate_code_bits(np.array(symbols, np.int64), classes.astype(np.uint8), kinds, reach)

    np.testing.assert_allclose((2.0**-bits).sum(axis=1), 1, rtol=1e-9)  # Kraft's equality
    assert bits.size <= kinds * 4096
    if max([0, *symbols]) - min([0, *symbols]) < 4000:
        assert least <= min([0, *symbols]) - reach
        assert least + bits.shape[1] > max([0, *symbols]) + reach


def test_symbol_bits_follow_the_frequencies() -> None:
    symbols, classes = np.array([0] * 700 + [1] * 200 + [-1] * 100), np.zeros(1000, np.uint8)

    bits, least = estimate_code_bits(symbols, classes, 1, 1)

    assert bits[0, -least] == pytest.approx(-math.log2(0.7), abs=0.01)
    assert bits[0, 1 - least] == pytest.approx(-math.log2(0.2), abs=0.01)
    assert bits[0, 2 - least] > 9


@given(st.data())
@examples(80)
def test_the_chosen_symbol_has_the_lowest_cost_within_reach(data: st.DataObject) -> None:
    pairs = data.draw(st.lists(st.tuples(st.integers(-6, 6), st.floats(-0.5, 0.5)), min_size=1, max_size=20))
    nearest = np.array([symbol for symbol, _ in pairs])
    values = nearest + np.array([offset for _, offset in pairs])
    reach, distortion = data.draw(st.integers(0, 4)), data.draw(st.floats(0, 2))
    classes = (np.arange(len(pairs)) % 2).astype(np.uint8)
    bits, least = estimate_code_bits(nearest, classes, 2, reach)

    def cost(place: int, symbol: int) -> float:
        error = (symbol - values[place]) ** 2
        return error + 2 * math.log(2) * distortion * bits[classes[place], symbol - least]

    chosen = choose_symbols(nearest, lambda symbols: (symbols - values) ** 2, classes, (bits, least), distortion, reach)

    for place, symbol in enumerate(chosen.tolist()):
        candidates = range(nearest[place] - reach, nearest[place] + reach + 1)
        assert symbol in candidates
        assert cost(place, symbol) <= min(cost(place, candidate) for candidate in candidates) + 1e-12


@given(st.data())
@examples(60)
def test_reach_never_raises_the_cost_by_the_coders_estimate(data: st.DataObject) -> None:
    values = np.array(data.draw(st.lists(st.floats(-20, 20), min_size=1, max_size=60)))
    groups = random_groups(len(values), data.draw(st.integers(1, 4)))
    distortion = 10.0 ** data.draw(st.floats(-3, 2))
    near, far = (quantize_groups(values, groups, np.ones(len(values)), distortion, reach) for reach in (0, 1))
    models = far.models[groups.index]
    bits, least = estimate_code_bits(near.symbols, models, ENTROPY_MODEL_COUNT, 1)

    def cost(chosen: GroupSymbols) -> float:
        steps = decode_step(choose_step_codes(np.ones(1), distortion)) / FIXED_POINT_ONE
        error = ((chosen.symbols * steps - values) ** 2).sum()
        return error + 2 * math.log(2) * distortion * bits[models, chosen.symbols - least].sum()

    assert cost(far) <= cost(near) * (1 + 1e-12)


@pytest.mark.parametrize("error", [0.1, 0.3, 1.0, 3.0])
def test_reach_lowers_the_rate_distortion_cost(error: float) -> None:
    groups = random_groups(30_000, 8)
    values, ones = laplace_values(groups), np.ones(30_000)

    def cost(reach: int) -> float:
        chosen = quantize_groups(values, groups, ones, error**2, reach)
        bits = 8 * len(encode_groups(chosen, groups))
        return float(((chosen.values - values) ** 2).sum()) + 2 * math.log(2) * error**2 * bits

    assert cost(1) < cost(0)

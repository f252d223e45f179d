"""Quantisers and whole files for values that are few, identical, huge, tiny, skewed or very many."""

from __future__ import annotations

import dataclasses
import tracemalloc
from collections.abc import Callable
from contextlib import contextmanager
from functools import partial

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from property_tests import examples
from scenes import camera_at, small_model

from hyrfpack.errors import HyrfError
from hyrfpack.format import decode_model, encode_model
from hyrfpack.format.codec import PROFILES
from hyrfpack.format.compact.plan import Plan
from hyrfpack.model import HashGridConfig, HybridModel
from hyrfpack.model.hash_grid import FEATURES_PER_LEVEL
from hyrfpack.quant import (
    HuffmanCode,
    HuffmanStream,
    MinMaxParams,
    MinMaxQuantizer,
    ResidualVectorQuantizer,
    huffman_decode,
    huffman_encode,
)
from hyrfpack.quant.huffman import MAX_CODE_BITS
from hyrfpack.quant.steps import MAX_ABS_SYMBOL as LARGEST_SYMBOL
from hyrfpack.render import render_view
from tools.safety.synthetic_encoding import quantize_uniformly

LARGEST_FLOAT32 = float(np.finfo(np.float32).max)
SMALLEST_FLOAT32 = 2.0**-149


def encode_and_decode(symbols: np.ndarray, code: HuffmanCode | None = None) -> tuple[np.ndarray, int]:
    """Return the symbols decoded from their bytes, and the number of bytes."""
    data = huffman_encode(symbols, code).to_bytes()
    return huffman_decode(HuffmanStream.from_bytes(data)), len(data)


def fibonacci(count: int) -> np.ndarray:
    numbers = [1, 1]
    while len(numbers) < count:
        numbers.append(numbers[-1] + numbers[-2])
    return np.array(numbers[:count])


# -- Huffman codes ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("place", [0, 1023, 1024, 777_777, 1_000_000])
def test_one_rare_symbol_in_a_million_costs_one_bit_a_symbol(dtype, place):
    symbols = np.full(1_000_001, 7, dtype)
    symbols[place] = 200

    decoded, size = encode_and_decode(symbols)

    np.testing.assert_array_equal(decoded, symbols)
    assert size <= 1_000_001 / 8 + 2100  # one bit each, and at most 1,024 chunk sizes of 2 bytes


@given(st.lists(st.integers(1, 10**9) | st.integers(1, 3), min_size=1, max_size=80))
@examples(150)
def test_no_histogram_needs_longer_codes_than_the_fibonacci_numbers(counts):
    """A code of L bits needs at least F(L + 2) - 1 symbols (the end mark is one more leaf, of weight 1)."""
    lengths = HuffmanCode.from_frequencies(np.array(counts)).lengths

    assert sum(counts) >= fibonacci(int(lengths.max()) + 2)[-1] - 1


def test_the_largest_possible_table_needs_no_codes_longer_than_the_limit():
    """A file has fewer than 2^30 symbols, which need 42 bits at most, and the codec supports 57."""
    grid = HashGridConfig(log2_table_size=24, levels=32, base=256, finest=65536)
    for past in ({"log2_table_size": 25}, {"levels": 33}):
        with pytest.raises(ValueError, match="must lie in"):
            dataclasses.replace(grid, **past)

    longest = max(length for length in range(1, 90) if fibonacci(length + 2)[-1] - 1 <= grid.rows * FEATURES_PER_LEVEL)

    assert longest == 42 < MAX_CODE_BITS
    assert (
        fibonacci(MAX_CODE_BITS + 3)[-1] - 1 > 1000 * grid.rows * FEATURES_PER_LEVEL
    )  # the symbols for one bit more than the codec supports


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_the_longest_codes_round_trip_at_every_bit_of_a_byte(dtype):
    code = HuffmanCode.from_frequencies(fibonacci(MAX_CODE_BITS))
    assert code.lengths.max() == MAX_CODE_BITS
    rare = np.flatnonzero(code.codes_by_symbol(256)[1] >= MAX_CODE_BITS - 1).astype(dtype)
    fillers = [np.full(count, MAX_CODE_BITS - 1, dtype) for count in range(65)]  # of one bit each
    symbols = np.concatenate([part for filler in fillers for part in (filler, rare)])

    decoded, _ = encode_and_decode(symbols, code)

    np.testing.assert_array_equal(decoded, symbols)


def test_a_histogram_one_bit_past_the_longest_code_is_rejected():
    with pytest.raises(ValueError, match="so skewed that a code is longer than 57 bits"):
        HuffmanCode.from_frequencies(fibonacci(MAX_CODE_BITS + 1))


@pytest.mark.parametrize("code", [None, HuffmanCode.from_frequencies(np.array([5, 3, 1]))])
def test_an_empty_stream_is_only_a_header_for_any_code(code):
    decoded, size = encode_and_decode(np.zeros(0, np.uint8), code)

    assert decoded.shape == (0,)
    assert size <= 26 + (2 * len(code.symbols) - 1 if code else 0)


# -- min-max ---------------------------------------------------------------------------------------------------------


def min_max_error(values: np.ndarray, bits: int = 8) -> np.ndarray:
    codes, params = MinMaxQuantizer(bits).encode(values)
    decoded = MinMaxQuantizer.decode(codes, MinMaxParams.from_bytes(params.to_bytes()))
    assert decoded.dtype == np.float32 and np.isfinite(decoded).all()
    return np.abs(decoded.astype(np.float64) - values)


@pytest.mark.parametrize("bits", [1, 8, 16])
def test_a_range_beyond_float32_keeps_half_a_step(bits):
    """max - min is 6.8e38, which is infinite as float32 and would make every code zero or NaN."""
    values = np.float32([-LARGEST_FLOAT32, -1.0, 0.0, 1e38, LARGEST_FLOAT32])

    error = min_max_error(values, bits)

    assert error.max() <= 2 * LARGEST_FLOAT32 / (2 * (2**bits - 1)) * (1 + 2.0**-22)
    assert error[[0, -1]].max() == 0


def test_subnormal_ranges_keep_half_a_step():
    """The step is below the smallest float32; float32 arithmetic would make it zero and divide by zero."""
    values = np.arange(-100, 101).astype(np.float32) * np.float32(SMALLEST_FLOAT32)

    assert min_max_error(values, 8).max() <= 200 * SMALLEST_FLOAT32 / 510 + SMALLEST_FLOAT32 / 2
    assert min_max_error(values[:2], 8).max() == 0


def test_zeros_of_both_signs_are_a_constant_channel():
    codes, params = MinMaxQuantizer().encode(np.float32([0.0, -0.0, 0.0, -0.0]))

    decoded = MinMaxQuantizer.decode(codes, params)

    assert decoded.tolist() == [0, 0, 0, 0]
    assert not codes.any()


def test_one_outlier_costs_the_other_values_what_the_bound_states():
    """This cost is known and accepted, as in the paper: the whole table has one range."""
    values = np.append(np.random.default_rng(0).uniform(-1, 1, 10_000), 510.0).astype(np.float32)

    error = min_max_error(values, 8)

    half_a_step = (510.0 - values.min()) / 510
    assert 0.9 * half_a_step < error.max() <= half_a_step * (1 + 1e-6)


# -- residual vector quantisation ------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", ["float32", "float16"])
@pytest.mark.parametrize("rows", [1, 2, 3])
@pytest.mark.parametrize("size", [1, 256, 65536])
def test_codebooks_of_any_size_for_a_few_rows(rows, size, dtype):
    values = np.float32([[1.5, -2.0], [-0.0, 2.0**-24], [65504.0, 3.0]])[:rows]

    indices, codebooks = ResidualVectorQuantizer(2, size, dtype).encode(values)
    decoded = ResidualVectorQuantizer.decode(indices, codebooks)

    assert indices.shape == (rows, 2) and codebooks.shape == (2, size, 2)
    if size >= rows:
        np.testing.assert_array_equal(decoded, values)  # every number is representable in half precision
    assert np.abs(decoded - values).max() <= np.ptp(values)


def column_errors(column: np.ndarray, dtype: str) -> tuple[float, np.ndarray]:
    """Return the mean squared error of two normal columns, and the errors of the column between them."""
    values = np.random.default_rng(1).standard_normal((len(column), 2)).astype(np.float32)
    values = np.insert(values, 1, column.astype(np.float32), axis=1)
    quantizer = ResidualVectorQuantizer(3, 64, dtype)
    errors = quantizer.decode(*quantizer.encode(values)).astype(np.float64) - values
    return float((errors[:, [0, 2]] ** 2).mean()), np.abs(errors[:, 1])


@pytest.mark.parametrize("size", [1e-10, 1e-40, SMALLEST_FLOAT32])
def test_a_column_below_the_steps_of_float16_becomes_zero_and_does_not_affect_others(size):
    digits = np.random.default_rng(2).integers(1, 10, 3000)

    others, error = column_errors(digits * size, "float16")

    assert error.max() <= 9 * size * (1 + 1e-6)
    assert others < 1.1 * column_errors(np.zeros(3000), "float16")[0]


@pytest.mark.parametrize("size", [2.0**-140, 2.0**90])
def test_a_column_of_any_size_is_coded_alike(size):
    digits = np.random.default_rng(2).integers(1, 10, 3000)

    others, error = column_errors(digits * size, "float32")

    usual_others, usual = column_errors(digits, "float32")
    assert others == pytest.approx(usual_others, rel=0.3)
    assert (error / size).mean() == pytest.approx(usual.mean(), rel=0.3)


def test_two_values_are_exact_for_any_share():
    values = np.full((50_000, 3), [0.5, -8.0, 100.0], np.float32)
    values[31_415] = -1.0, 2.0, 4000.0

    decoded = ResidualVectorQuantizer.decode(*ResidualVectorQuantizer(1, 2, "float16").encode(values))

    np.testing.assert_array_equal(decoded, values)


def test_the_largest_values_of_both_signs_stay_finite_and_close():
    values = np.random.default_rng(2).choice(np.float32([-1e30, -1e29, 0, 1e29, 1e30]), (500, 2))

    decoded = ResidualVectorQuantizer.decode(*ResidualVectorQuantizer(3, 64).encode(values))

    np.testing.assert_allclose(decoded, values, atol=1e24)


# -- ten million values ----------------------------------------------------------------------------------------------

MANY_VALUES = 10_000_000


@contextmanager
def limit_memory(bytes_per_value: float):
    """Check the peak of all memory that is allocated inside, results included."""
    tracemalloc.start()
    try:
        yield
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak <= bytes_per_value * MANY_VALUES


# Measured peaks in bytes a value were 4.1 and 4.8 (8 bits), 8.1 and 7.8 (16 bits).
@pytest.mark.acceptance
@pytest.mark.parametrize(("dtype", "allowed"), [(np.uint8, 6), (np.uint16, 11)])
def test_ten_million_symbols_round_trip_in_bounded_memory(dtype, allowed):
    rng = np.random.default_rng(3)
    symbols = np.clip(rng.laplace(np.iinfo(dtype).max / 2, 10, MANY_VALUES), 0, np.iinfo(dtype).max).astype(dtype)

    with limit_memory(allowed):
        stream = huffman_encode(symbols)
    with limit_memory(allowed):
        decoded = huffman_decode(stream)

    assert np.array_equal(decoded, symbols)


def test_ten_million_numbers_keep_half_a_step_in_bounded_memory():
    values = np.random.default_rng(4).standard_normal(MANY_VALUES).astype(np.float32)

    with limit_memory(10):
        codes, params = MinMaxQuantizer().encode(values)
    with limit_memory(6):
        decoded = MinMaxQuantizer.decode(codes, params)

    half_a_step = (params.maximum - params.minimum) / 510
    assert np.abs(decoded - values).max() <= half_a_step * (1 + 1e-5)


@pytest.mark.acceptance
def test_ten_million_rows_are_vector_quantised_in_bounded_memory():
    """The bound is close to Lloyd's quantiser of 16 levels for a normal distribution: 0.0095 (Max 1960)."""
    values = np.random.default_rng(5).standard_normal((MANY_VALUES, 1)).astype(np.float32)

    with limit_memory(30):
        indices, codebooks = ResidualVectorQuantizer(1, 16, "float16").encode(values)
    with limit_memory(11):
        decoded = ResidualVectorQuantizer.decode(indices, codebooks)

    assert ((decoded - values) ** 2).mean() < 1.05 * 0.009497


# -- whole files -----------------------------------------------------------------------------------------------------


def fill_constant(value: float) -> Callable[[HybridModel], None]:
    def fill(model: HybridModel) -> None:
        for parameter in model.parameters():
            parameter.fill_(value)

    return fill


def fill_wide_tables(model: HybridModel) -> None:
    """Fill tables with values from one end of float32 to the other, and decoders that ignore them."""
    for field in (model.geometry, model.radiance):
        field.grid.table[0], field.grid.table[-1] = -LARGEST_FLOAT32, LARGEST_FLOAT32
        for weights in field.weights:
            weights.zero_()


FILL_BY_NAME = {
    "drawn": lambda model: None,
    "all zero": fill_constant(0.0),
    "all minus zero": fill_constant(-0.0),
    "all an eighth": fill_constant(0.125),
    "all the smallest": fill_constant(SMALLEST_FLOAT32),
    "tables as wide as float32": fill_wide_tables,
}


PLANNED_STEP = 2.0**-10
# Allowed errors of `compact` in its steps: half a step to the nearest value, and one to a cheaper value (for opacities
# four). Colours are rotated.
MAX_ERROR_STEPS = {"color_logits": 1.5 * 3**0.5, "opacity_logits": 4.5}


def check_compact(model: HybridModel, decoded: HybridModel, plan: Plan) -> None:
    """Check all numbers against their steps; numbers of tables beyond 2^24 steps are clipped."""
    step, cut = PLANNED_STEP * 16 / 15, LARGEST_SYMBOL * PLANNED_STEP
    for name, expected in model.state_dict().items():
        got, kind = decoded.state_dict()[name], name.removeprefix("gaussians.")
        if kind == "positions":
            expected, got = model.cube_coords(expected.double()), model.cube_coords(got.double())
            allowed = step / 2 + 1e-6
        else:
            allowed = step * MAX_ERROR_STEPS.get(kind, 1.5) + 2e-6
        expected = expected[plan.kept] if kind != name else expected
        inside = expected.abs() < cut
        assert ((got - expected)[inside].abs() <= allowed).all(), name
        assert ((got[~inside] / (cut * expected[~inside].sign()) - 1).abs() < 0.07).all(), name


@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("fill", FILL_BY_NAME)
@pytest.mark.parametrize("count", [0, 1, 2])
def test_models_of_at_most_two_gaussians_can_be_stored_and_rendered(profile, fill, count):
    model = small_model(np.random.default_rng(count).normal(size=(count, 3)), fields=1.0, background=True)
    with torch.no_grad():
        FILL_BY_NAME[fill](model)
    settings = {"quantized": quantize_uniformly(model, PLANNED_STEP)} if profile == "compact" else {}

    data = encode_model(model, profile, **settings)
    decoded = decode_model(data)

    assert len(decoded) == count and encode_model(model, profile, **settings) == data
    if profile == "compact":
        check_compact(model, decoded, settings["quantized"].plan)
    for name, expected in model.state_dict().items() if profile != "compact" else ():
        got = decoded.state_dict()[name]
        if profile == "raw":
            assert np.array_equal(got.numpy().view(np.uint32), expected.numpy().view(np.uint32)), name
        elif "table" in name:
            half_a_step = (float(expected.max()) - float(expected.min())) / 510
            assert (got.double() - expected.double()).abs().max() <= half_a_step * (1 + 1e-6), name
        else:
            assert ((got - expected).abs() <= expected.abs() * 2.0**-10 + 2.0**-24).all(), name
    with torch.no_grad():
        rgb = render_view(decoded, camera_at((0, -4, 0), width=9, height=7)).rgb
    assert torch.isfinite(rgb).all()


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("profile", PROFILES)
def test_one_number_that_is_not_finite_is_rejected_in_every_group(profile, value):
    for name in small_model(np.zeros((2, 3))).state_dict():
        model = small_model(np.zeros((2, 3)))
        write = (
            quantize_uniformly(model, PLANNED_STEP).plan.apply
            if profile == "compact"
            else partial(encode_model, profile=profile)
        )
        with torch.no_grad():
            model.state_dict()[name].view(-1)[-1] = value

        with pytest.raises(HyrfError, match="^1 of [0-9]+ numbers in the model's [a-z ]+ are NaN or infinite; "):
            write(model)

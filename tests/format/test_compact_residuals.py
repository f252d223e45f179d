"""Codec 13, residuals: a round trip keeps every symbol, and damaged or hostile bytes are refused."""

from __future__ import annotations

import struct
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from property_tests import examples

from hyrfpack.format.compact.residuals import (
    BASIS_BYTES,
    MAX_RESIDUAL_CLASSES,
    ResidualSymbols,
    decode_residual_symbols,
    decode_residuals,
    encode_residuals,
    residual_bands,
)
from hyrfpack.format.sections import HARMONICS, SHAPES
from hyrfpack.quant import DamagedDataError
from hyrfpack.quant.integers import encode_integers
from hyrfpack.quant.steps import MAX_ABS_SYMBOL
from tools.safety import minimal_reader

SHAPE_COLUMNS = 5
COLUMNS_OF_DEGREE_2 = 27


def random_residuals(
    group: str, columns: int, count: int, class_count: int, share: float, largest: int = 40, seed: int = 0
) -> tuple[ResidualSymbols, np.ndarray, np.ndarray | None]:
    """Return random symbols, the classes of all Gaussians, and a basis for colours."""
    rng = np.random.default_rng(seed)
    flags, bands = rng.random(count) < share, residual_bands(group, columns)
    residuals = ResidualSymbols(
        flags,
        [rng.integers(0, 256, class_count).astype(np.uint8) for _ in bands],
        [rng.integers(-largest, largest + 1, (int(flags.sum()), band.width)) for band in bands],
    )
    basis = np.linalg.qr(rng.normal(size=(3, 3)))[0].astype(np.float32) if group == HARMONICS else None
    return residuals, rng.integers(0, class_count, count).astype(np.uint8), basis


SAMPLE_RESIDUALS = random_residuals(HARMONICS, COLUMNS_OF_DEGREE_2, 16, 3, 0.5)
SAMPLE_DATA = encode_residuals(HARMONICS, SAMPLE_RESIDUALS[0], SAMPLE_RESIDUALS[1], SAMPLE_RESIDUALS[2])


@given(
    st.sampled_from([(SHAPES, SHAPE_COLUMNS), *((HARMONICS, 3 * (degree + 1) ** 2) for degree in range(4))]),
    st.integers(0, 80),
    st.integers(1, MAX_RESIDUAL_CLASSES),
    st.sampled_from([0.0, 0.1, 0.7, 1.0]),
    st.sampled_from([0, 1, 300, MAX_ABS_SYMBOL]),
    st.integers(0, 2**32 - 1),
)
@examples(60)
def test_a_round_trip_keeps_flags_steps_and_symbols_in_both_readers(section, count, class_count, share, largest, seed):
    group, columns = section
    residuals, classes, basis = random_residuals(group, columns, count, class_count, share, largest, seed)
    data = encode_residuals(group, residuals, classes, basis)

    decoded, decoded_basis = decode_residual_symbols(group, memoryview(data), classes, columns)

    np.testing.assert_array_equal(decoded.flags, residuals.flags)
    for ours, theirs in zip((*decoded.codes, *decoded.symbols), (*residuals.codes, *residuals.symbols), strict=True):
        np.testing.assert_array_equal(ours, theirs)
    assert basis is None or np.array_equal(basis, decoded_basis)
    numbers = decode_residuals(group, memoryview(data), classes, columns)
    source = minimal_reader.Cursor(memoryview(data))
    expected = minimal_reader.read_residuals(source, columns, classes.astype(int), group == HARMONICS)
    np.testing.assert_array_equal(numbers, expected.astype(np.float32))
    assert not numbers[~residuals.flags].any()


def test_truncation_at_every_byte_and_trailing_bytes_are_refused() -> None:
    for data in (*(SAMPLE_DATA[:length] for length in range(len(SAMPLE_DATA))), SAMPLE_DATA + b"\0"):
        with pytest.raises(DamagedDataError):
            decode_residuals(HARMONICS, memoryview(data), SAMPLE_RESIDUALS[1], COLUMNS_OF_DEGREE_2)


@given(st.data())
@examples(150)
def test_damaged_data_is_refused_or_decodes_to_finite_numbers(data: st.DataObject) -> None:
    damaged = bytearray(SAMPLE_DATA)
    for _ in range(data.draw(st.integers(1, 4))):
        damaged[data.draw(st.integers(0, len(damaged) - 1))] ^= data.draw(st.integers(1, 255))
    try:
        numbers = decode_residuals(HARMONICS, memoryview(bytes(damaged)), SAMPLE_RESIDUALS[1], COLUMNS_OF_DEGREE_2)
    except DamagedDataError:
        return
    assert np.isfinite(numbers).all()


def test_a_flag_of_2_is_refused() -> None:
    residuals, classes, _ = random_residuals(SHAPES, SHAPE_COLUMNS, 20, 2, 0.5)
    flags = residuals.flags.astype(np.uint8)
    (size,) = struct.unpack_from("<I", data := encode_residuals(SHAPES, residuals, classes), 1)
    forged = encode_integers(2 * flags, classes)
    with pytest.raises(DamagedDataError, match="a flag is neither 0 nor 1"):
        decode_residuals(
            SHAPES,
            memoryview(data[:1] + struct.pack("<I", len(forged)) + forged + data[5 + size :]),
            classes,
            SHAPE_COLUMNS,
        )


@pytest.mark.parametrize("class_count", [0, 1, MAX_RESIDUAL_CLASSES + 1])
def test_classes_without_a_step_and_too_many_steps_are_refused(class_count: int) -> None:
    residuals, classes, _ = random_residuals(SHAPES, SHAPE_COLUMNS, 20, 2, 0.5)
    data = bytes([class_count]) + encode_residuals(SHAPES, residuals, classes)[1:]
    with pytest.raises(DamagedDataError, match=f"the steps of {class_count} classes"):
        decode_residuals(SHAPES, memoryview(data), classes, SHAPE_COLUMNS)


@pytest.mark.parametrize("entry", [1.1, float("nan"), float("inf")])
def test_a_basis_with_an_entry_beyond_1_is_refused(entry: float) -> None:
    (size,) = struct.unpack_from("<I", SAMPLE_DATA, 1)
    basis = struct.pack("<9f", *[entry] * 9)
    data = SAMPLE_DATA[: 5 + size] + basis + SAMPLE_DATA[5 + size + BASIS_BYTES :]
    with pytest.raises(DamagedDataError, match="basis"):
        decode_residuals(HARMONICS, memoryview(data), SAMPLE_RESIDUALS[1], COLUMNS_OF_DEGREE_2)


def test_a_symbol_beyond_the_limit_is_refused() -> None:
    residuals, classes, _ = random_residuals(SHAPES, SHAPE_COLUMNS, 20, 2, 1.0)
    symbols = [np.full_like(values, MAX_ABS_SYMBOL + 1) for values in residuals.symbols]
    data = encode_residuals(SHAPES, replace(residuals, symbols=symbols), classes)
    with pytest.raises(DamagedDataError, match="more than 16777216 steps"):
        decode_residuals(SHAPES, memoryview(data), classes, SHAPE_COLUMNS)

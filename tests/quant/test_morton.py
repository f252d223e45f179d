from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from property_tests import examples

from hyrfpack.quant.morton import MAX_BITS_PER_AXIS, morton_cells, morton_codes, spread_bits

CELL_COORDINATE = st.one_of(st.integers(0, 3), st.integers(0, 2**21 - 1), st.integers(0, 20).map(lambda bit: 1 << bit))


def interleave_bits(cell: tuple[int, int, int]) -> int:
    """Apply the definition bit by bit: bit 3 i + a of the code is bit i of coordinate a."""
    return sum((coordinate >> i & 1) << 3 * i + axis for axis, coordinate in enumerate(cell) for i in range(21))


@given(st.lists(st.tuples(CELL_COORDINATE, CELL_COORDINATE, CELL_COORDINATE), max_size=40))
@examples(150)
def test_morton_codes_interleave_bits_and_morton_cells_inverts_them(cells: list[tuple[int, int, int]]) -> None:
    array = np.array(cells, np.int64).reshape(-1, 3)

    codes = morton_codes(array)

    assert codes.dtype == np.int64
    assert codes.tolist() == [interleave_bits(cell) for cell in cells]
    np.testing.assert_array_equal(morton_cells(codes), array)


@given(st.lists(CELL_COORDINATE, max_size=40))
@examples(50)
def test_spreading_bits_of_tensors_moves_bit_i_to_bit_3_i(numbers: list[int]) -> None:
    expected = [interleave_bits((number, 0, 0)) for number in numbers]
    assert spread_bits(torch.tensor(numbers, dtype=torch.int64)).tolist() == expected


def test_every_single_bit_round_trips() -> None:
    cells = np.concatenate([np.eye(3, dtype=np.int64) << bit for bit in range(21)])

    codes = morton_codes(cells)

    assert codes.tolist() == [1 << bit for bit in range(63)]
    np.testing.assert_array_equal(morton_cells(codes), cells)


def test_codes_of_a_16_cube_are_distinct_and_consecutive() -> None:
    cells = np.stack(np.meshgrid(*[np.arange(16)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)

    codes = morton_codes(cells)

    assert sorted(codes.tolist()) == list(range(16**3))


@pytest.mark.parametrize("dtype", [np.uint8, np.int32, np.uint32, np.uint64])
def test_cells_of_any_integer_dtype_are_accepted(dtype: type) -> None:
    cells = np.array([[255, 0, 129], [1, 2, 3]], dtype)

    assert morton_codes(cells).tolist() == [interleave_bits(cell) for cell in cells.tolist()]


def test_the_largest_gap_between_codes_fits_the_integer_coder() -> None:
    corner = morton_codes(np.full((1, 3), (1 << MAX_BITS_PER_AXIS) - 1))

    assert 0 < int(corner[0]) < 2**56

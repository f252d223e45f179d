"""Kernels for arrays of which only the first rows are in use, as many as a number on the device says.

The host does not wait for that number. It launches kernels for all rows; programs without a row in use return at once
and leave their part of the result undefined.
"""

from __future__ import annotations

import triton
import triton.language as tl
from torch import Tensor

_ROWS_PER_PROGRAM = 256
_WARPS_PER_PROGRAM = 4


@triton.jit
def count_used_rows(used, total):
    """Return how many of `total` rows are in use: the int64 at the pointer `used`, or all if it is None."""
    if used is not None:
        total = tl.load(used).to(tl.int32)
    return total


@triton.jit(do_not_specialize=["total", "capacity"])
def partition_kernel(chosen, ends, total, capacity, indices, used, BLOCK: tl.constexpr):
    """List the chosen rows in order, and after them the others, as far as there is room.

    Args:
        chosen: (total,) uint8.
        ends: (total,) int64, the running count of chosen rows.
        indices: (capacity,) int64, written.
        used: (1,) int64, written: the number of chosen rows that are listed.
    """
    index = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = index < total
    end = tl.load(ends + index, mask=live, other=0)
    is_chosen = tl.load(chosen + index, mask=live, other=0) != 0
    count = tl.load(ends + total - 1)
    place = tl.where(is_chosen, end - 1, count + index - end)
    tl.store(indices + place, index.to(tl.int64), mask=live & (place < capacity))
    if tl.program_id(0) == 0:
        tl.store(used, tl.minimum(count, capacity))


@triton.jit(do_not_specialize=["total", "row_stride", "column_stride"])
def move_rows_kernel(
    rows, values, row_stride, column_stride, index, used, total,
    SCATTER: tl.constexpr, WIDTH: tl.constexpr, WIDTH_P: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Write rows[i] = values[index[i]], or values[index[i]] = rows[i] if SCATTER, for the rows i in use.

    Args:
        rows: (total, WIDTH), contiguous. WIDTH_P is the power of two at or above WIDTH.
        values: (N, WIDTH) of any strides.
        index: (total,) int64.
        used: the number of rows in use, see `count_used_rows`.
    """
    row = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    live = row < count_used_rows(used, total)
    there = tl.load(index + row, mask=live, other=0)
    column = tl.arange(0, WIDTH_P)[None, :]
    inside = live[:, None] & (column < WIDTH)
    at, value_at = rows + row[:, None] * WIDTH + column, values + there[:, None] * row_stride + column * column_stride
    if SCATTER:
        tl.store(value_at, tl.load(at, mask=inside, other=0.0), mask=inside)
    else:
        tl.store(at, tl.load(value_at, mask=inside, other=0.0), mask=inside)


def partition_rows(chosen: Tensor, ends: Tensor, capacity: int) -> tuple[Tensor, Tensor]:
    """Return the indices (capacity,) int64 of the chosen rows, then of others, and the number (1,) of chosen ones.

    Args:
        chosen: (N,) uint8, N at least 1.
        ends: (N,) int64, the running count of chosen rows.
        capacity: the largest number of rows to list, at most N.
    """
    total = len(chosen)
    indices, used = ends.new_empty(capacity), ends.new_empty(1)
    partition_kernel[(triton.cdiv(total, _ROWS_PER_PROGRAM),)](
        chosen, ends, total, capacity, indices, used, BLOCK=_ROWS_PER_PROGRAM, num_warps=_WARPS_PER_PROGRAM
    )
    return indices, used


def gather_rows(values: Tensor, index: Tensor, used: Tensor) -> Tensor:
    """Return values[index], (n, C) float32, for the indices in use."""
    rows = values.new_empty(len(index), values.shape[1])
    _move_rows(rows, values.detach(), index, used, scatter=False)
    return rows


def scatter_rows(rows: Tensor, index: Tensor, used: Tensor, values: Tensor) -> None:
    """Write the rows (n, C) in use to values[index]; no index occurs twice."""
    _move_rows(rows.detach().contiguous(), values, index, used, scatter=True)


def _move_rows(rows: Tensor, values: Tensor, index: Tensor, used: Tensor, *, scatter: bool) -> None:
    total, width = rows.shape
    if total:
        move_rows_kernel[(triton.cdiv(total, _ROWS_PER_PROGRAM),)](
            rows, values, *values.stride(), index, used, total, SCATTER=scatter,
            WIDTH=width, WIDTH_P=triton.next_power_of_2(width), BLOCK=_ROWS_PER_PROGRAM, num_warps=_WARPS_PER_PROGRAM,
        )  # fmt: skip

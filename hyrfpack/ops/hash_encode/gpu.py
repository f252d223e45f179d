"""Multiresolution hash encoding in Triton, two features a level.

A program does a block of points on one level. Programs run level after level, so that the table of one level, a few
megabytes, stays in the L2 cache while all points read it. A row of the table (two float32) is fetched as one 64-bit
number. Features and their gradients are planar, (2L, N), so that neighbouring threads write neighbouring numbers.

Points add to the table's gradient by atomics, and a row takes one at a time: on a level of 8 vertices an axis a third
of the points may share one. So coarse levels have several copies that blocks add to by turns, and that are summed at
last.

The cell is the floor of the rounded product coords * span, as in `reference.cells`: a product that goes to a floor
cannot be fused into anything. The place within the cell, product - cell, may be fused; it is then off the reference's
by the rounding of the product, and only there.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import pairwise

import torch
import triton
import triton.language as tl
from torch import Tensor

from hyrfpack.ops.gpu_pairs import unpack_pair
from hyrfpack.ops.hash_encode.reference import PRIME_Y, PRIME_Z, level_offsets

# One point a thread: no value changes threads on its way to a fetch or an atomic, and 32 registers let every thread
# that a multiprocessor can hold have its 8 fetches under way.
_POINTS = 256
_WARPS = _POINTS // (64 if torch.version.hip else 32)
_MOST_COPIES = 32
_SUMMED = 512  # numbers that a program sums the copies of


@triton.jit
def axis_vertices(coords, span, factor):
    """Place within the cell along one axis, and the shares of its two vertices in the row; always inside the level."""
    x = coords * span
    cell = tl.minimum(tl.where(x > 0, tl.floor(x), 0.0), span - 1)  # a NaN, too, is in a cell
    low = cell.to(tl.int32).to(tl.uint32) * factor
    return x - cell, low, low + factor


@triton.jit
def _cell(coords, axis_stride, point_stride, levels, level, start, lane, inside):
    """Places and vertex shares along x, y, z of points on a level, and that level's span, hash mask and first row."""
    levels += level * 5
    span = tl.load(levels).to(tl.float32)
    first = coords + start * point_stride
    x = tl.load(first + lane * point_stride, mask=inside, other=0.0)
    y = tl.load(first + axis_stride.to(tl.int64) + lane * point_stride, mask=inside, other=0.0)
    z = tl.load(first + axis_stride.to(tl.int64) * 2 + lane * point_stride, mask=inside, other=0.0)
    x1, row_x0, row_x1 = axis_vertices(x, span, 1)
    y1, row_y0, row_y1 = axis_vertices(y, span, tl.load(levels + 1).to(tl.uint32))
    z1, row_z0, row_z1 = axis_vertices(z, span, tl.load(levels + 2).to(tl.uint32))
    mask, offset = tl.load(levels + 3).to(tl.uint32), tl.load(levels + 4)
    return x1, y1, z1, row_x0, row_x1, row_y0, row_y1, row_z0, row_z1, span, mask, offset


@triton.jit
def vertex_row(x, y, z, mask):
    """Row of a vertex within its level, from its shares; `mask` is 0 on a dense level."""
    return tl.where(mask == 0, x + y + z, (x ^ y ^ z) & mask).to(tl.int32)


@triton.jit(do_not_specialize=["points", "axis_stride"])
def encode_level(coords, axis_stride, point_stride, table, levels, out, points, POINTS: tl.constexpr):
    """Features of a block of points (axis 0) on a level (axis 1) into planar `out` (2L, N)."""
    start, level = tl.program_id(0).to(tl.int64) * POINTS, tl.program_id(1)
    lane = tl.arange(0, POINTS)
    inside = lane < points - start
    x1, y1, z1, row_x0, row_x1, row_y0, row_y1, row_z0, row_z1, span, mask, offset = _cell(
        coords, axis_stride, point_stride, levels, level, start, lane, inside
    )
    table += offset
    feature0, feature1 = tl.zeros([POINTS], tl.float32), tl.zeros([POINTS], tl.float32)
    for corner in tl.static_range(8):
        x, row_x = (x1, row_x1) if corner & 1 else (1 - x1, row_x0)
        y, row_y = (y1, row_y1) if corner & 2 else (1 - y1, row_y0)
        z, row_z = (z1, row_z1) if corner & 4 else (1 - z1, row_z0)
        value0, value1 = unpack_pair(tl.load(table + vertex_row(row_x, row_y, row_z, mask)))
        weight = x * (y * z)
        feature0 += weight * value0
        feature1 += weight * value1
    out += (2 * level).to(tl.int64) * points + start
    tl.store(out + lane, feature0, mask=inside)
    tl.store(out + points + lane, feature1, mask=inside)


@triton.jit(do_not_specialize=["points", "axis_stride", "feature_stride"])
def scatter_level(
    coords, axis_stride, point_stride, levels, copies,
    grad, feature_stride, grad_stride, out, points, POINTS: tl.constexpr,
):  # fmt: skip
    """Add the gradients of a block of points (axis 0) on a level (axis 1) to a copy of it in `out` (rows, 2)."""
    start, level = tl.program_id(0).to(tl.int64) * POINTS, tl.program_id(1)
    lane = tl.arange(0, POINTS)
    inside = lane < points - start
    grad += (2 * level).to(tl.int64) * feature_stride + start * grad_stride
    grad0 = tl.load(grad + lane * grad_stride, mask=inside, other=0.0)
    grad1 = tl.load(grad + feature_stride + lane * grad_stride, mask=inside, other=0.0)
    live = (grad0 != 0) | (grad1 != 0)
    x1, y1, z1, row_x0, row_x1, row_y0, row_y1, row_z0, row_z1, span, mask, offset = _cell(
        coords, axis_stride, point_stride, levels, level, start, lane, live
    )
    copies += level * 3
    copy = tl.program_id(0) % tl.load(copies + 1)
    out += tl.where(copy == 0, offset, tl.load(copies + 2) + (copy - 1) * tl.load(copies)) * 2
    pair = tl.join(grad0, grad1)
    feature = tl.arange(0, 2)
    for corner in tl.static_range(8):
        x, row_x = (x1, row_x1) if corner & 1 else (1 - x1, row_x0)
        y, row_y = (y1, row_y1) if corner & 2 else (1 - y1, row_y0)
        z, row_z = (z1, row_z1) if corner & 4 else (1 - z1, row_z0)
        row = vertex_row(row_x, row_y, row_z, mask)
        weight = x * (y * z)
        tl.atomic_add(
            out + (row[:, None] * 2 + feature[None, :]), weight[:, None] * pair, mask=live[:, None], sem="relaxed"
        )


@triton.jit
def sum_copies(levels, copies, out, BLOCK: tl.constexpr):
    """Add the other copies of a level (axis 1) to its rows in `out` (rows, 2), a block of numbers (axis 0)."""
    level = tl.program_id(1)
    rows, count = tl.load(copies + level * 3), tl.load(copies + level * 3 + 1)
    lane = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mine = (lane < rows * 2) & (count > 1)
    to = out + tl.load(levels + level * 5 + 4) * 2 + lane
    total = tl.load(to, mask=mine, other=0.0)
    other = out + tl.load(copies + level * 3 + 2) * 2 + lane
    for _ in range(1, count):
        total += tl.load(other, mask=mine, other=0.0)
        other += rows * 2
    tl.store(to, total, mask=mine)


@triton.jit(do_not_specialize=["points", "axis_stride", "feature_stride", "out_axis_stride"])
def descend_levels(
    coords,
    axis_stride,
    point_stride,
    table,
    levels,
    grad,
    feature_stride,
    grad_stride,
    out,
    out_axis_stride,
    out_point_stride,
    points,
    LEVELS: tl.constexpr,
    POINTS: tl.constexpr,
):
    """Gradient of the coordinates of a block of points (axis 0), summed over all levels in order, into `out`."""
    start = tl.program_id(0).to(tl.int64) * POINTS
    lane = tl.arange(0, POINTS)
    inside = lane < points - start
    grad += start * grad_stride
    total_x, total_y = tl.zeros([POINTS], tl.float32), tl.zeros([POINTS], tl.float32)
    total_z = tl.zeros([POINTS], tl.float32)
    for level in range(LEVELS):
        x1, y1, z1, row_x0, row_x1, row_y0, row_y1, row_z0, row_z1, span, mask, offset = _cell(
            coords, axis_stride, point_stride, levels, level, start, lane, inside
        )
        grad0 = tl.load(grad + lane * grad_stride, mask=inside, other=0.0)
        grad1 = tl.load(grad + feature_stride + lane * grad_stride, mask=inside, other=0.0)
        grad += feature_stride.to(tl.int64) * 2
        along_x, along_y = tl.zeros([POINTS], tl.float32), tl.zeros([POINTS], tl.float32)
        along_z = tl.zeros([POINTS], tl.float32)
        for corner in tl.static_range(8):
            x, row_x = (x1, row_x1) if corner & 1 else (1 - x1, row_x0)
            y, row_y = (y1, row_y1) if corner & 2 else (1 - y1, row_y0)
            z, row_z = (z1, row_z1) if corner & 4 else (1 - z1, row_z0)
            value0, value1 = unpack_pair(tl.load(table + offset + vertex_row(row_x, row_y, row_z, mask)))
            value = grad0 * value0 + grad1 * value1
            along_x += (value if corner & 1 else -value) * (y * z)
            along_y += (value if corner & 2 else -value) * (x * z)
            along_z += (value if corner & 4 else -value) * (x * y)
        total_x += span * along_x
        total_y += span * along_y
        total_z += span * along_z
    out += start * out_point_stride
    tl.store(out + lane * out_point_stride, total_x, mask=inside)
    tl.store(out + out_axis_stride.to(tl.int64) + lane * out_point_stride, total_y, mask=inside)
    tl.store(out + out_axis_stride.to(tl.int64) * 2 + lane * out_point_stride, total_z, mask=inside)


@cache
def level_numbers(resolutions: tuple[int, ...], log2_table_size: int, device: torch.device) -> Tensor:
    """(L, 5) int64 on the device: span, what a step along y and along z adds, hash mask (0: dense), first row."""
    size, rows = 1 << log2_table_size, []
    for resolution, offset in zip(resolutions, level_offsets(resolutions, log2_table_size), strict=False):
        dense = resolution**3 <= size
        steps = (resolution, resolution**2, 0) if dense else (PRIME_Y, PRIME_Z, size - 1)
        rows.append((resolution - 1, *steps, offset))
    return torch.tensor(rows, device=device)


@dataclass(frozen=True)
class Copies:
    """Where points add to a table's gradient.

    Attributes:
        numbers: (L, 3) int64 on the device: a level's rows, its copies, and the first row of the second one.
        levels: up to the last that has several.
        widest: rows of the largest that has several.
        rows: of all, the table's own first.
    """

    numbers: Tensor
    levels: int
    widest: int
    rows: int


def copies_for(points: int, resolutions: tuple[int, ...], log2_table_size: int, device: torch.device) -> Copies:
    """Copies of the levels that so many points, at least one, add to.

    Of a level that has no more vertices than there are points as many as take no more rows than there are points, so
    that they cost an eighth of the additions at most; of finer ones one, for few points share a row there.
    """
    return _copies(points.bit_length() - 1, resolutions, log2_table_size, device)


@cache
def _copies(log2_points: int, resolutions: tuple[int, ...], log2_table_size: int, device: torch.device) -> Copies:
    """As `copies_for`, of a power of two: points of a view differ from step to step."""
    offsets = level_offsets(resolutions, log2_table_size)
    points, numbers, end, levels, widest = 1 << log2_points, [], offsets[-1], 0, 0
    for level, (resolution, (first, last)) in enumerate(zip(resolutions, pairwise(offsets), strict=True)):
        rows = last - first
        copies = min(_MOST_COPIES, points // rows) if resolution**3 <= points else 1
        numbers.append((rows, copies, end))
        end += (copies - 1) * rows
        if copies > 1:
            levels, widest = level + 1, max(widest, rows)
    return Copies(torch.tensor(numbers, device=device), levels, widest, end)


def _blocks(points: int) -> int:
    return triton.cdiv(points, _POINTS)


def whole_rows(table: Tensor) -> Tensor:
    """The (rows, 2) float32 table as one 64-bit number a row."""
    table = table.detach().contiguous()
    if table.storage_offset() % 2:  # between two such numbers of the memory that it is a part of
        table = table.clone()
    return table.view(torch.int64)


def encode(coords: Tensor, table: Tensor, resolutions: tuple[int, ...], log2_table_size: int) -> Tensor:
    """(N, 3) coords, in any layout, and (rows, 2) table -> (N, 2L) features, stored planar."""
    points = coords.shape[0]
    features = coords.new_empty((2 * len(resolutions), points))
    if points:
        encode_level[_blocks(points), len(resolutions)](
            coords.detach(),
            coords.stride(1),
            coords.stride(0),
            whole_rows(table),
            level_numbers(resolutions, log2_table_size, coords.device),
            features,
            points,
            POINTS=_POINTS,
            num_warps=_WARPS,
            enable_fp_fusion=True,
        )
    return features.T


def grad_table(
    coords: Tensor, table: Tensor, resolutions: tuple[int, ...], log2_table_size: int, grad: Tensor
) -> Tensor:
    """(N, 2L) gradient of the features, in any layout -> gradient of the table, of its shape.

    Points add to rows by atomics, in no fixed order: sums differ in their last bits from run to run. A point whose
    two gradients on a level are zero adds nothing there.
    """
    points = coords.shape[0]
    if not points:
        return table.new_zeros(table.shape)
    levels = level_numbers(resolutions, log2_table_size, coords.device)
    copies = copies_for(points, resolutions, log2_table_size, coords.device)
    result = table.new_zeros(copies.rows, 2)
    scatter_level[_blocks(points), len(resolutions)](
        coords.detach(), coords.stride(1), coords.stride(0), levels, copies.numbers,
        grad, grad.stride(1), grad.stride(0), result, points,
        POINTS=_POINTS, num_warps=_WARPS, enable_fp_fusion=True,
    )  # fmt: skip
    if copies.levels:
        sum_copies[triton.cdiv(2 * copies.widest, _SUMMED), copies.levels](
            levels, copies.numbers, result, BLOCK=_SUMMED, num_warps=_WARPS
        )
    return result[: len(table)]


def grad_coords(
    coords: Tensor, table: Tensor, resolutions: tuple[int, ...], log2_table_size: int, grad: Tensor
) -> Tensor:
    """(N, 2L) gradient of the features, in any layout -> (N, 3) gradient of the coordinates, stored like these."""
    points = coords.shape[0]
    result = torch.empty_like(coords)
    if points:
        descend_levels[(_blocks(points),)](
            coords.detach(),
            coords.stride(1),
            coords.stride(0),
            whole_rows(table),
            level_numbers(resolutions, log2_table_size, coords.device),
            grad,
            grad.stride(1),
            grad.stride(0),
            result,
            result.stride(1),
            result.stride(0),
            points,
            LEVELS=len(resolutions),
            POINTS=_POINTS,
            num_warps=_WARPS,
            enable_fp_fusion=True,
        )
    return result

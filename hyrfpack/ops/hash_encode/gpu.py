"""Implements multiresolution hash encoding in Triton, with two features per level.

A program processes a block of points on one level. Programs run in the order of levels, so that the table of one level,
a few megabytes, stays in the L2 cache while all points read it. A row of the table (two float32) is loaded as one
64-bit word. Features and their gradients are planar, (2L, N), so that neighbouring threads write neighbouring numbers.

Points add to the table's gradient by atomics. Additions to the same row are serialised, and on a level of 8 vertices
per axis a third of the points may share a row. Coarse levels therefore have several copies, to which blocks add in
turn; a last kernel sums the copies. A thread handles consecutive points, and sums the gradients of those in the same
cell before it adds them: neighbours in training's order of Gaussians mostly share a cell. In any other order it adds
as often as there are points, and executes no more instructions for each than a thread with one point.

The cell is the floor of the rounded product coords * span, as in `reference.cells`: the compiler cannot fuse a product
whose floor is taken. It may fuse the position within the cell, product - cell, which then differs from the reference by
the rounding of the product.
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
from hyrfpack.ops.gpu_rows import count_used_rows
from hyrfpack.ops.hash_encode.reference import PRIME_Y, PRIME_Z, level_offsets

# Each thread handles one point, so that no value moves between threads on its way to a load or an atomic. With 32
# registers per thread, a multiprocessor runs its maximum number of threads, each with 8 loads in flight.
_POINTS_PER_PROGRAM = 256
_THREADS_PER_WARP = 64 if torch.version.hip else 32
_WARPS_PER_PROGRAM = _POINTS_PER_PROGRAM // _THREADS_PER_WARP
# For the table's gradient, a thread handles consecutive points, whose gradients it sums while they share a cell.
_POINTS_PER_THREAD = 8
_THREADS_PER_PROGRAM = 128
_MAX_COPIES_PER_LEVEL = 32
_SUMS_PER_PROGRAM = 512


@triton.jit
def axis_vertices(coords, span, factor):
    """Locate points along one axis.

    Returns:
        The position within the cell, and the terms of its two vertices in the row, which always lie inside the level.
    """
    x = coords * span
    cell = tl.minimum(tl.where(x > 0, tl.floor(x), 0.0), span - 1)  # This puts NaN into a cell, too.
    low = cell.to(tl.int32).to(tl.uint32) * factor
    return x - cell, low, low + factor


@triton.jit
def _locate_cell(coords, axis_stride, point_stride, levels, level, start, lane, inside):
    """Locate points on a level.

    Returns:
        Positions within the cells and row terms of the vertices along x, y and z, as of `axis_vertices`; then the
        level's span, hash mask and first row.
    """
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
    """Return the row of a vertex within its level from its terms along x, y, z; `mask` is 0 on a dense level."""
    return tl.where(mask == 0, x + y + z, (x ^ y ^ z) & mask).to(tl.int32)


@triton.jit(do_not_specialize=["points", "axis_stride"])
def encode_kernel(coords, axis_stride, point_stride, table, levels, out, points, used, POINTS: tl.constexpr):
    """Write the features of a block of points (grid axis 0) on a level (grid axis 1) to planar `out` (2L, N)."""
    start, level = tl.program_id(0).to(tl.int64) * POINTS, tl.program_id(1)
    count = count_used_rows(used, points)
    if start >= count:
        return
    lane = tl.arange(0, POINTS)
    inside = lane < count - start
    x1, y1, z1, row_x0, row_x1, row_y0, row_y1, row_z0, row_z1, span, mask, offset = _locate_cell(
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
def grad_table_kernel(
    coords, axis_stride, point_stride, levels, copies,
    grad, feature_stride, grad_stride, out, points, used, THREADS: tl.constexpr, RUN: tl.constexpr,
):  # fmt: skip
    """Add gradients of a block of points (grid axis 0) to a copy of a level (grid axis 1) in `out` (rows, 2).

    Each of THREADS threads takes RUN consecutive points. It sums the gradients of consecutive ones in the same cell,
    and adds them to the table when the cell changes, and at the end.
    """
    start, level = tl.program_id(0).to(tl.int64) * (THREADS * RUN), tl.program_id(1)
    count = count_used_rows(used, points)
    if start >= count:
        return
    grad += (2 * level).to(tl.int64) * feature_stride + start * grad_stride
    copies += level * 3
    copy = tl.program_id(0) % tl.load(copies + 1)
    out += tl.where(copy == 0, tl.load(levels + level * 5 + 4), tl.load(copies + 2) + (copy - 1) * tl.load(copies)) * 2
    feature = tl.arange(0, 2)
    zero_sum, zero_term = tl.zeros([THREADS, 2], tl.float32), tl.zeros([THREADS], tl.uint32)
    sums, cell, has_sum = (zero_sum,) * 8, (zero_term,) * 6, zero_term != 0
    for step in range(RUN + 1):  # The last step only adds what is left.
        lane = tl.arange(0, THREADS) * RUN + step
        inside = (lane < count - start) & (step < RUN)
        grad0 = tl.load(grad + lane * grad_stride, mask=inside, other=0.0)
        grad1 = tl.load(grad + feature_stride + lane * grad_stride, mask=inside, other=0.0)
        live = (grad0 != 0) | (grad1 != 0)
        x1, y1, z1, row_x0, row_x1, row_y0, row_y1, row_z0, row_z1, _, mask, _ = _locate_cell(
            coords, axis_stride, point_stride, levels, level, start, lane, live
        )
        other_cell = (row_x0 != cell[0]) | (row_y0 != cell[2]) | (row_z0 != cell[4])
        is_run_end = has_sum & ((live & other_cell) | (step == RUN))
        pair = tl.join(grad0, grad1)
        for corner in tl.static_range(8):
            row = vertex_row(cell[corner & 1], cell[2 + (corner >> 1 & 1)], cell[4 + (corner >> 2)], mask)
            at = out + (row[:, None] * 2 + feature[None, :])
            tl.atomic_add(at, sums[0], mask=is_run_end[:, None], sem="relaxed")
            x, y, z = (
                x1 if corner & 1 else 1 - x1,
                y1 if corner & 2 else 1 - y1,
                z1 if corner & 4 else 1 - z1,
            )
            weight = x * (y * z)
            # The sum of the next corner becomes the first, so that after 8 corners the order is as before.
            sums = sums[1:] + (tl.where(is_run_end[:, None], 0.0, sums[0]) + weight[:, None] * pair,)
        cell = (
            tl.where(live, row_x0, cell[0]), tl.where(live, row_x1, cell[1]),
            tl.where(live, row_y0, cell[2]), tl.where(live, row_y1, cell[3]),
            tl.where(live, row_z0, cell[4]), tl.where(live, row_z1, cell[5]),
        )  # fmt: skip
        has_sum = has_sum | live


@triton.jit
def sum_copies_kernel(levels, copies, out, BLOCK: tl.constexpr):
    """Add the further copies of a level (grid axis 1) to its first in `out` (rows, 2), by blocks (grid axis 0)."""
    level = tl.program_id(1)
    rows, count = tl.load(copies + level * 3), tl.load(copies + level * 3 + 1)
    lane = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mine = (lane < rows * 2) & (count > 1)
    to = out + tl.load(levels + level * 5 + 4) * 2 + lane
    total = tl.load(to, mask=mine, other=0.0)
    other = out + tl.load(copies + level * 3 + 2) * 2 + lane
    copy = 1
    while copy < count:  # Triton 3.6's interpreter takes no tensor as the end of a range.
        total += tl.load(other, mask=mine, other=0.0)
        other += rows * 2
        copy += 1
    tl.store(to, total, mask=mine)


@triton.jit(do_not_specialize=["points", "axis_stride", "feature_stride", "out_axis_stride"])
def grad_coords_kernel(
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
    used,
    LEVELS: tl.constexpr,
    POINTS: tl.constexpr,
):
    """Write the gradient of the coordinates for a block of points (grid axis 0), summed over levels in order."""
    start = tl.program_id(0).to(tl.int64) * POINTS
    count = count_used_rows(used, points)
    if start >= count:
        return
    lane = tl.arange(0, POINTS)
    inside = lane < count - start
    grad += start * grad_stride
    total_x, total_y = tl.zeros([POINTS], tl.float32), tl.zeros([POINTS], tl.float32)
    total_z = tl.zeros([POINTS], tl.float32)
    for level in range(LEVELS):
        x1, y1, z1, row_x0, row_x1, row_y0, row_y1, row_z0, row_z1, span, mask, offset = _locate_cell(
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
def level_parameters(resolutions: tuple[int, ...], log2_table_size: int, device: torch.device) -> Tensor:
    """Return the parameters of each level, (L, 5) int64 on the device.

    They are the span (vertices per axis - 1), the row factors along y and z, the hash mask (0 for a dense level) and
    the first row.
    """
    size, rows = 1 << log2_table_size, []
    for resolution, offset in zip(resolutions, level_offsets(resolutions, log2_table_size), strict=False):
        dense = resolution**3 <= size
        steps = (resolution, resolution**2, 0) if dense else (PRIME_Y, PRIME_Z, size - 1)
        rows.append((resolution - 1, *steps, offset))
    return torch.tensor(rows, device=device)


@dataclass(frozen=True)
class GradientCopies:
    """The copies of levels to which points add their gradients.

    Attributes:
        layout: (L, 3) int64 on the device: a level's rows, its number of copies, and the first row of its second copy.
        copied_levels: number of levels up to the last one with several copies.
        max_copied_rows: rows of the largest level with several copies.
        total_rows: rows of all copies, of which the table's own come first.
    """

    layout: Tensor
    copied_levels: int
    max_copied_rows: int
    total_rows: int


def plan_gradient_copies(
    points: int, resolutions: tuple[int, ...], log2_table_size: int, device: torch.device
) -> GradientCopies:
    """Plan the copies of levels for the gradients of at least one point.

    A level whose vertices do not outnumber the points gets about points / rows copies, at most _MAX_COPIES_PER_LEVEL.
    Summing these takes at most an eighth of all additions. A finer level gets one, since few points share a row there.
    """
    return _plan_gradient_copies(points.bit_length() - 1, resolutions, log2_table_size, device)


@cache
def _plan_gradient_copies(
    log2_points: int, resolutions: tuple[int, ...], log2_table_size: int, device: torch.device
) -> GradientCopies:
    """Plan the copies for 2^log2_points points. Powers of two keep the cache small as the number of points varies."""
    offsets = level_offsets(resolutions, log2_table_size)
    points, numbers, end, levels, widest = 1 << log2_points, [], offsets[-1], 0, 0
    for level, (resolution, (first, last)) in enumerate(zip(resolutions, pairwise(offsets), strict=True)):
        rows = last - first
        copies = min(_MAX_COPIES_PER_LEVEL, points // rows) if resolution**3 <= points else 1
        numbers.append((rows, copies, end))
        end += (copies - 1) * rows
        if copies > 1:
            levels, widest = level + 1, max(widest, rows)
    return GradientCopies(torch.tensor(numbers, device=device), levels, widest, end)


def _program_count(points: int) -> int:
    """Return the number of programs for a number of points."""
    return triton.cdiv(points, _POINTS_PER_PROGRAM)


def rows_as_words(table: Tensor) -> Tensor:
    """Return the (rows, 2) float32 table as one 64-bit word per row."""
    table = table.detach().contiguous()
    if table.storage_offset() % 2:  # Words of a view at an odd offset would not be aligned to 8 bytes.
        table = table.clone()
    return table.view(torch.int64)


def encode(
    coords: Tensor, table: Tensor, resolutions: tuple[int, ...], log2_table_size: int, used: Tensor | None = None
) -> Tensor:
    """Compute the features (N, 2L), stored planar, of coords (N, 3), in any layout, from a table (rows, 2)."""
    points = coords.shape[0]
    features = coords.new_empty((2 * len(resolutions), points))
    if points:
        encode_kernel[_program_count(points), len(resolutions)](
            coords.detach(),
            coords.stride(1),
            coords.stride(0),
            rows_as_words(table),
            level_parameters(resolutions, log2_table_size, coords.device),
            features,
            points,
            used,
            POINTS=_POINTS_PER_PROGRAM,
            num_warps=_WARPS_PER_PROGRAM,
            enable_fp_fusion=True,
        )
    return features.T


def grad_table(
    coords: Tensor,
    table: Tensor,
    resolutions: tuple[int, ...],
    log2_table_size: int,
    grad: Tensor,
    used: Tensor | None = None,
) -> Tensor:
    """Compute the gradient of the table, in its shape, from the gradient (N, 2L) of the features, in any layout.

    Points add to rows by atomics, in no fixed order, so sums differ in their last bits from run to run. A point whose
    two gradients on a level are zero is skipped there.
    """
    points = coords.shape[0]
    if not points:
        return table.new_zeros(table.shape)
    levels = level_parameters(resolutions, log2_table_size, coords.device)
    copies = plan_gradient_copies(points, resolutions, log2_table_size, coords.device)
    result = table.new_zeros(copies.total_rows, 2)
    programs = triton.cdiv(points, _THREADS_PER_PROGRAM * _POINTS_PER_THREAD)
    grad_table_kernel[programs, len(resolutions)](
        coords.detach(), coords.stride(1), coords.stride(0), levels, copies.layout,
        grad, grad.stride(1), grad.stride(0), result, points, used,
        THREADS=_THREADS_PER_PROGRAM, RUN=_POINTS_PER_THREAD,
        num_warps=_THREADS_PER_PROGRAM // _THREADS_PER_WARP, enable_fp_fusion=True,
    )  # fmt: skip
    if copies.copied_levels:
        sum_copies_kernel[triton.cdiv(2 * copies.max_copied_rows, _SUMS_PER_PROGRAM), copies.copied_levels](
            levels, copies.layout, result, BLOCK=_SUMS_PER_PROGRAM, num_warps=_WARPS_PER_PROGRAM
        )
    return result[: len(table)]


def grad_coords(
    coords: Tensor,
    table: Tensor,
    resolutions: tuple[int, ...],
    log2_table_size: int,
    grad: Tensor,
    used: Tensor | None = None,
) -> Tensor:
    """Compute the gradient (N, 3) of the coordinates, in their layout, from the gradient (N, 2L) of the features."""
    points = coords.shape[0]
    result = torch.empty_like(coords)
    if points:
        grad_coords_kernel[(_program_count(points),)](
            coords.detach(),
            coords.stride(1),
            coords.stride(0),
            rows_as_words(table),
            level_parameters(resolutions, log2_table_size, coords.device),
            grad,
            grad.stride(1),
            grad.stride(0),
            result,
            result.stride(1),
            result.stride(0),
            points,
            used,
            LEVELS=len(resolutions),
            POINTS=_POINTS_PER_PROGRAM,
            num_warps=_WARPS_PER_PROGRAM,
            enable_fp_fusion=True,
        )
    return result

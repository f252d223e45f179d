"""Implements multiresolution hash encoding in Numba, with two features per level.

Coordinates, features and their gradients are planar, (3, N) and (2L, N). Every loop over points thus reads and writes
whole cache lines, and no two levels share one. For a block of points, a vectorised loop first computes rows and
weights; a second loop then reads the table. Gradients need no atomics: each thread owns one level (gradient of the
table) or one range of points (gradient of the coordinates), which also fixes the order of every sum.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from hyrfpack.ops.hash_encode.reference import PRIME_Y, PRIME_Z, level_offsets
from hyrfpack.parallel.compiled import compiled
from hyrfpack.parallel.pool import run_tasks

njit = compiled(fastmath={"contract", "nsz", "nnan", "reassoc", "arcp"})

_POINTS_PER_BLOCK = 64  # The rows and weights of a block (4 KiB) then stay in the L1 cache.
_POINTS_PER_TASK = 16384
_MIN_PARALLEL_POINTS = 512  # Fewer points are finished before another thread has started.

# Constants are typed, so that indices stay uint64, hashes uint32 and values float32 in the kernels.
_BLOCK_STRIDE = np.uint64(_POINTS_PER_BLOCK)
_0, _1, _2 = np.uint64(0), np.uint64(1), np.uint64(2)
_PRIME_Y, _PRIME_Z = np.uint32(PRIME_Y), np.uint32(PRIME_Z)
_UINT32_0, _UINT32_1 = np.uint32(0), np.uint32(1)
_FLOAT32_1 = np.float32(1)


@njit
def _cell(x, last):
    """Return the cell, in 0 to last, of a coordinate that is scaled to the level."""
    # A coordinate outside the cube may exceed every integer, and NaN passes the comparisons of floats.
    nearest = min(max(x, np.float32(0)), np.float32(last))
    return min(max(np.int32(nearest), np.int32(0)), last)


@njit
def _locate_corners(coords, start, count, resolution, mask, rows, fractions):
    """Compute the rows of the 8 corners and the position inside the cell for a block of points.

    Rows are doubled, as indices into a flat table of two features per row. `mask` is 0 on a dense level. The rows lie
    inside the level for all coordinates.
    """
    span = np.float32(resolution - 1)
    last = np.int32(resolution - 2)
    side = np.uint32(resolution)
    for j in range(count):
        j = np.uint64(j)
        x, y, z = coords[_0, start + j] * span, coords[_1, start + j] * span, coords[_2, start + j] * span
        cell_x = _cell(x, last)
        cell_y = _cell(y, last)
        cell_z = _cell(z, last)
        fractions[j] = x - np.float32(cell_x)
        fractions[j + _BLOCK_STRIDE] = y - np.float32(cell_y)
        fractions[j + _2 * _BLOCK_STRIDE] = z - np.float32(cell_z)
        x0, y0, z0 = np.uint32(cell_x), np.uint32(cell_y), np.uint32(cell_z)
        if mask == _UINT32_0:
            x1, y0, z0 = x0 + _UINT32_1, y0 * side, z0 * side * side
            y1, z1 = y0 + side, z0 + side * side
            for c in range(8):
                row = (x1 if c & 1 else x0) + (y1 if c & 2 else y0) + (z1 if c & 4 else z0)
                rows[j + np.uint64(c) * _BLOCK_STRIDE] = row << _UINT32_1
        else:
            x1, y0, z0 = x0 + _UINT32_1, y0 * _PRIME_Y, z0 * _PRIME_Z
            y1, z1 = y0 + _PRIME_Y, z0 + _PRIME_Z
            for c in range(8):
                row = (x1 if c & 1 else x0) ^ (y1 if c & 2 else y0) ^ (z1 if c & 4 else z0)
                rows[j + np.uint64(c) * _BLOCK_STRIDE] = (row & mask) << _UINT32_1


@njit
def _corner_weights(count, fractions, weights):
    """Compute the trilinear weights of the 8 corners from the positions inside the cells."""
    for j in range(count):
        j = np.uint64(j)
        x1, y1, z1 = fractions[j], fractions[j + _BLOCK_STRIDE], fractions[j + _2 * _BLOCK_STRIDE]
        x0, y0, z0 = _FLOAT32_1 - x1, _FLOAT32_1 - y1, _FLOAT32_1 - z1
        for c in range(8):
            weight = (x1 if c & 1 else x0) * ((y1 if c & 2 else y0) * (z1 if c & 4 else z0))
            weights[j + np.uint64(c) * _BLOCK_STRIDE] = weight


@njit
def _encode_level(coords, table, resolution, mask, start, stop, out):
    """Write the features of points [start, stop) on one level to `out` (2, N), from the flat `table` (rows * 2,)."""
    rows, weights = np.empty(8 * _POINTS_PER_BLOCK, np.uint32), np.empty(8 * _POINTS_PER_BLOCK, np.float32)
    fractions = np.empty(3 * _POINTS_PER_BLOCK, np.float32)
    for first in range(start, stop, _POINTS_PER_BLOCK):
        count = np.uint64(min(_POINTS_PER_BLOCK, stop - first))
        first = np.uint64(first)
        _locate_corners(coords, first, count, resolution, mask, rows, fractions)
        _corner_weights(count, fractions, weights)
        for j in range(count):
            j = np.uint64(j)
            feature0 = feature1 = np.float32(0)
            for c in range(8):
                k = j + np.uint64(c) * _BLOCK_STRIDE
                row = np.uint64(rows[k])
                feature0 += weights[k] * table[row]
                feature1 += weights[k] * table[row + _1]
            out[_0, first + j] = feature0
            out[_1, first + j] = feature1


@njit
def _add_table_grad(coords, grad, resolution, mask, grad_table):
    """Add the gradient `grad` (2, N) of each point to the corners of its cell in flat `grad_table`, on one level."""
    rows, weights = np.empty(8 * _POINTS_PER_BLOCK, np.uint32), np.empty(8 * _POINTS_PER_BLOCK, np.float32)
    fractions = np.empty(3 * _POINTS_PER_BLOCK, np.float32)
    for first in range(0, coords.shape[1], _POINTS_PER_BLOCK):
        count = np.uint64(min(_POINTS_PER_BLOCK, coords.shape[1] - first))
        first = np.uint64(first)
        _locate_corners(coords, first, count, resolution, mask, rows, fractions)
        _corner_weights(count, fractions, weights)
        for j in range(count):
            j = np.uint64(j)
            grad0, grad1 = grad[_0, first + j], grad[_1, first + j]
            if grad0 == 0 and grad1 == 0:  # as of Gaussians that no pixel shows
                continue
            for c in range(8):
                k = j + np.uint64(c) * _BLOCK_STRIDE
                row = np.uint64(rows[k])
                grad_table[row] += weights[k] * grad0
                grad_table[row + _1] += weights[k] * grad1


@njit
def _add_coords_grad(coords, table, grad, resolution, mask, start, stop, grad_coords):
    """Add the gradient of the coordinates from one level's gradient `grad` (2, N) to `grad_coords` (3, N).

    Only points [start, stop) are handled.
    """
    rows, fractions = np.empty(8 * _POINTS_PER_BLOCK, np.uint32), np.empty(3 * _POINTS_PER_BLOCK, np.float32)
    span = np.float32(resolution - 1)
    for first in range(start, stop, _POINTS_PER_BLOCK):
        count = np.uint64(min(_POINTS_PER_BLOCK, stop - first))
        first = np.uint64(first)
        _locate_corners(coords, first, count, resolution, mask, rows, fractions)
        for j in range(count):
            j = np.uint64(j)
            x1, y1, z1 = fractions[j], fractions[j + _BLOCK_STRIDE], fractions[j + _2 * _BLOCK_STRIDE]
            x0, y0, z0 = _FLOAT32_1 - x1, _FLOAT32_1 - y1, _FLOAT32_1 - z1
            grad0, grad1 = grad[_0, first + j], grad[_1, first + j]
            along_x = along_y = along_z = np.float32(0)
            for c in range(8):
                row = np.uint64(rows[j + np.uint64(c) * _BLOCK_STRIDE])
                value = grad0 * table[row] + grad1 * table[row + _1]
                x, y, z = x1 if c & 1 else x0, y1 if c & 2 else y0, z1 if c & 4 else z0
                along_x += (value if c & 1 else -value) * (y * z)
                along_y += (value if c & 2 else -value) * (x * z)
                along_z += (value if c & 4 else -value) * (x * y)
            grad_coords[_0, first + j] += span * along_x
            grad_coords[_1, first + j] += span * along_y
            grad_coords[_2, first + j] += span * along_z


def _hash_mask(resolution: int, log2_table_size: int) -> np.uint32:
    """Return the bit mask that reduces a hash to a row; 0 for a dense level."""
    size = 1 << log2_table_size
    return np.uint32(0 if resolution**3 <= size else size - 1)


def _to_planar(values: Tensor) -> np.ndarray:
    """Return an (N, C) tensor as a (C, N) array, without a copy if the tensor is stored planar."""
    return values.detach().T.contiguous().numpy()


def _split_levels(flat: np.ndarray, resolutions: tuple[int, ...], log2_table_size: int) -> list[np.ndarray]:
    """Split the flat table into levels, each (rows * 2,)."""
    offsets = level_offsets(resolutions, log2_table_size)
    return [flat[2 * first : 2 * last] for first, last in zip(offsets, offsets[1:], strict=False)]


def encode(coords: Tensor, table: Tensor, resolutions: tuple[int, ...], log2_table_size: int) -> Tensor:
    """Compute the features (N, 2L), stored planar, of coords (N, 3) from a table (rows, 2)."""
    planes = _to_planar(coords)
    tables = _split_levels(table.detach().contiguous().view(-1).numpy(), resolutions, log2_table_size)
    points = planes.shape[1]
    features = torch.empty(2 * len(resolutions), points)
    out = features.numpy()
    parts = -(-points // _POINTS_PER_TASK)

    def task(index: int) -> None:
        level, part = divmod(index, parts)
        start, stop = points * part // parts, points * (part + 1) // parts
        mask = _hash_mask(resolutions[level], log2_table_size)
        _encode_level(planes, tables[level], resolutions[level], mask, start, stop, out[2 * level : 2 * level + 2])

    run_tasks(task, parts * len(resolutions), sequential=points < _MIN_PARALLEL_POINTS)
    return features.T


def grad_table(
    coords: Tensor, table: Tensor, resolutions: tuple[int, ...], log2_table_size: int, grad: Tensor
) -> Tensor:
    """Compute the gradient of the table, in its shape, from the gradient (N, 2L) of the features."""
    planes, grads = _to_planar(coords), _to_planar(grad)
    result = torch.zeros(table.shape)
    levels = _split_levels(result.view(-1).numpy(), resolutions, log2_table_size)

    def task(level: int) -> None:
        mask = _hash_mask(resolutions[level], log2_table_size)
        _add_table_grad(planes, grads[2 * level : 2 * level + 2], resolutions[level], mask, levels[level])

    run_tasks(task, len(resolutions), sequential=planes.shape[1] < _MIN_PARALLEL_POINTS)
    return result


def grad_coords(
    coords: Tensor, table: Tensor, resolutions: tuple[int, ...], log2_table_size: int, grad: Tensor
) -> Tensor:
    """Compute the gradient (N, 3) of the coordinates from the gradient (N, 2L) of the features."""
    planes, grads = _to_planar(coords), _to_planar(grad)
    tables = _split_levels(table.detach().contiguous().view(-1).numpy(), resolutions, log2_table_size)
    points = planes.shape[1]
    result = torch.zeros(3, points)
    out = result.numpy()
    parts = -(-points // _POINTS_PER_TASK)

    def task(part: int) -> None:
        start, stop = points * part // parts, points * (part + 1) // parts
        for level, resolution in enumerate(resolutions):
            mask = _hash_mask(resolution, log2_table_size)
            _add_coords_grad(
                planes, tables[level], grads[2 * level : 2 * level + 2], resolution, mask, start, stop, out
            )

    run_tasks(task, parts)
    return result.T

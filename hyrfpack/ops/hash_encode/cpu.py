"""Multiresolution hash encoding in Numba, two features a level.

Coordinates, features and their gradients are planar, (3, N) and (2L, N), so that every loop over points reads and
writes whole cache lines and no two levels share one. A block of points first gets its rows and weights, in a loop
that vectorises, and then fetches. Gradients need no atomics: one thread owns one level (table) or one range of
points (coordinates), which also fixes the order of every sum.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from hyrfpack.ops.hash_encode.reference import PRIME_Y, PRIME_Z, level_offsets
from hyrfpack.parallel.compiled import compiled
from hyrfpack.parallel.pool import run_tasks

njit = compiled(fastmath={"contract", "nsz", "nnan", "reassoc", "arcp"})

_BLOCK = 64  # points whose rows and weights (4 KiB) stay in the first cache
_POINTS_PER_TASK = 16384
_FEW = 512  # points, of which another thread would not be awake before they are done
_B = np.uint64(_BLOCK)
_0, _1, _2 = np.uint64(0), np.uint64(1), np.uint64(2)
_PRIME_Y, _PRIME_Z = np.uint32(PRIME_Y), np.uint32(PRIME_Z)
_U0, _U1, _UNIT = np.uint32(0), np.uint32(1), np.float32(1)


@njit
def _corners(coords, start, count, resolution, mask, rows, fractions):
    """Rows (doubled: two features each) of the 8 corners, and the position inside the cell, for a block of points.

    `mask` is 0 on a dense level. Whatever the coordinates, the rows stay inside the level.
    """
    span = np.float32(resolution - 1)
    last = np.int32(resolution - 2)
    side = np.uint32(resolution)
    for j in range(count):
        j = np.uint64(j)
        x, y, z = coords[_0, start + j] * span, coords[_1, start + j] * span, coords[_2, start + j] * span
        cell_x = min(max(np.int32(x), np.int32(0)), last)
        cell_y = min(max(np.int32(y), np.int32(0)), last)
        cell_z = min(max(np.int32(z), np.int32(0)), last)
        fractions[j] = x - np.float32(cell_x)
        fractions[j + _B] = y - np.float32(cell_y)
        fractions[j + _2 * _B] = z - np.float32(cell_z)
        x0, y0, z0 = np.uint32(cell_x), np.uint32(cell_y), np.uint32(cell_z)
        if mask == _U0:
            x1, y0, z0 = x0 + _U1, y0 * side, z0 * side * side
            y1, z1 = y0 + side, z0 + side * side
            for c in range(8):
                row = (x1 if c & 1 else x0) + (y1 if c & 2 else y0) + (z1 if c & 4 else z0)
                rows[j + np.uint64(c) * _B] = row << _U1
        else:
            x1, y0, z0 = x0 + _U1, y0 * _PRIME_Y, z0 * _PRIME_Z
            y1, z1 = y0 + _PRIME_Y, z0 + _PRIME_Z
            for c in range(8):
                row = (x1 if c & 1 else x0) ^ (y1 if c & 2 else y0) ^ (z1 if c & 4 else z0)
                rows[j + np.uint64(c) * _B] = (row & mask) << _U1


@njit
def _weigh(count, fractions, weights):
    """Trilinear weights of the 8 corners from the positions inside the cells."""
    for j in range(count):
        j = np.uint64(j)
        x1, y1, z1 = fractions[j], fractions[j + _B], fractions[j + _2 * _B]
        x0, y0, z0 = _UNIT - x1, _UNIT - y1, _UNIT - z1
        for c in range(8):
            weight = (x1 if c & 1 else x0) * ((y1 if c & 2 else y0) * (z1 if c & 4 else z0))
            weights[j + np.uint64(c) * _B] = weight


@njit
def _encode(coords, table, resolution, mask, start, stop, out):
    """Features of the points [start, stop) on one level: flat `table` (rows * 2) -> `out` (2, N)."""
    rows, weights = np.empty(8 * _BLOCK, np.uint32), np.empty(8 * _BLOCK, np.float32)
    fractions = np.empty(3 * _BLOCK, np.float32)
    for first in range(start, stop, _BLOCK):
        count = np.uint64(min(_BLOCK, stop - first))
        first = np.uint64(first)
        _corners(coords, first, count, resolution, mask, rows, fractions)
        _weigh(count, fractions, weights)
        for j in range(count):
            j = np.uint64(j)
            feature0 = feature1 = np.float32(0)
            for c in range(8):
                k = j + np.uint64(c) * _B
                row = np.uint64(rows[k])
                feature0 += weights[k] * table[row]
                feature1 += weights[k] * table[row + _1]
            out[_0, first + j] = feature0
            out[_1, first + j] = feature1


@njit
def _scatter(coords, grad, resolution, mask, grad_table):
    """Add every point's gradient `grad` (2, N) to the corners of its cell in flat `grad_table`, on one level."""
    rows, weights = np.empty(8 * _BLOCK, np.uint32), np.empty(8 * _BLOCK, np.float32)
    fractions = np.empty(3 * _BLOCK, np.float32)
    for first in range(0, coords.shape[1], _BLOCK):
        count = np.uint64(min(_BLOCK, coords.shape[1] - first))
        first = np.uint64(first)
        _corners(coords, first, count, resolution, mask, rows, fractions)
        _weigh(count, fractions, weights)
        for j in range(count):
            j = np.uint64(j)
            grad0, grad1 = grad[_0, first + j], grad[_1, first + j]
            for c in range(8):
                k = j + np.uint64(c) * _B
                row = np.uint64(rows[k])
                grad_table[row] += weights[k] * grad0
                grad_table[row + _1] += weights[k] * grad1


@njit
def _descend(coords, table, grad, resolution, mask, start, stop, grad_coords):
    """Add what one level's gradient `grad` (2, N) says to `grad_coords` (3, N), for the points [start, stop)."""
    rows, fractions = np.empty(8 * _BLOCK, np.uint32), np.empty(3 * _BLOCK, np.float32)
    span = np.float32(resolution - 1)
    for first in range(start, stop, _BLOCK):
        count = np.uint64(min(_BLOCK, stop - first))
        first = np.uint64(first)
        _corners(coords, first, count, resolution, mask, rows, fractions)
        for j in range(count):
            j = np.uint64(j)
            x1, y1, z1 = fractions[j], fractions[j + _B], fractions[j + _2 * _B]
            x0, y0, z0 = _UNIT - x1, _UNIT - y1, _UNIT - z1
            grad0, grad1 = grad[_0, first + j], grad[_1, first + j]
            along_x = along_y = along_z = np.float32(0)
            for c in range(8):
                row = np.uint64(rows[j + np.uint64(c) * _B])
                value = grad0 * table[row] + grad1 * table[row + _1]
                x, y, z = x1 if c & 1 else x0, y1 if c & 2 else y0, z1 if c & 4 else z0
                along_x += (value if c & 1 else -value) * (y * z)
                along_y += (value if c & 2 else -value) * (x * z)
                along_z += (value if c & 4 else -value) * (x * y)
            grad_coords[_0, first + j] += span * along_x
            grad_coords[_1, first + j] += span * along_y
            grad_coords[_2, first + j] += span * along_z


def _mask(resolution: int, log2_table_size: int) -> np.uint32:
    """What cuts a hash down to a row; 0 says that the level is dense."""
    size = 1 << log2_table_size
    return np.uint32(0 if resolution**3 <= size else size - 1)


def _planar(values: Tensor) -> np.ndarray:
    """(N, C) tensor -> (C, N) array; no copy where the tensor is stored planar already."""
    return values.detach().T.contiguous().numpy()


def _levels(flat: np.ndarray, resolutions: tuple[int, ...], log2_table_size: int) -> list[np.ndarray]:
    """The flat table cut into levels, each (rows * 2,)."""
    offsets = level_offsets(resolutions, log2_table_size)
    return [flat[2 * first : 2 * last] for first, last in zip(offsets, offsets[1:], strict=False)]


def encode(coords: Tensor, table: Tensor, resolutions: tuple[int, ...], log2_table_size: int) -> Tensor:
    """(N, 3) coords and (rows, 2) table -> (N, 2L) features, stored planar."""
    planes = _planar(coords)
    tables = _levels(table.detach().contiguous().view(-1).numpy(), resolutions, log2_table_size)
    points = planes.shape[1]
    features = torch.empty(2 * len(resolutions), points)
    out = features.numpy()
    parts = -(-points // _POINTS_PER_TASK)

    def task(index: int) -> None:
        level, part = divmod(index, parts)
        start, stop = points * part // parts, points * (part + 1) // parts
        mask = _mask(resolutions[level], log2_table_size)
        _encode(planes, tables[level], resolutions[level], mask, start, stop, out[2 * level : 2 * level + 2])

    run_tasks(task, parts * len(resolutions), sequential=points < _FEW)
    return features.T


def grad_table(
    coords: Tensor, table: Tensor, resolutions: tuple[int, ...], log2_table_size: int, grad: Tensor
) -> Tensor:
    """(N, 2L) gradient of the features -> gradient of the table, of its shape."""
    planes, grads = _planar(coords), _planar(grad)
    result = torch.zeros(table.shape)
    levels = _levels(result.view(-1).numpy(), resolutions, log2_table_size)

    def task(level: int) -> None:
        mask = _mask(resolutions[level], log2_table_size)
        _scatter(planes, grads[2 * level : 2 * level + 2], resolutions[level], mask, levels[level])

    run_tasks(task, len(resolutions), sequential=planes.shape[1] < _FEW)
    return result


def grad_coords(
    coords: Tensor, table: Tensor, resolutions: tuple[int, ...], log2_table_size: int, grad: Tensor
) -> Tensor:
    """(N, 2L) gradient of the features -> (N, 3) gradient of the coordinates."""
    planes, grads = _planar(coords), _planar(grad)
    tables = _levels(table.detach().contiguous().view(-1).numpy(), resolutions, log2_table_size)
    points = planes.shape[1]
    result = torch.zeros(3, points)
    out = result.numpy()
    parts = -(-points // _POINTS_PER_TASK)

    def task(part: int) -> None:
        start, stop = points * part // parts, points * (part + 1) // parts
        for level, resolution in enumerate(resolutions):
            mask = _mask(resolution, log2_table_size)
            _descend(planes, tables[level], grads[2 * level : 2 * level + 2], resolution, mask, start, stop, out)

    run_tasks(task, parts)
    return result.T

"""Computes the background at the nodes of a grid on the CPU.

Numba kernels find the nodes that are needed, and compute the field's inputs at each; the field's own kernels compute
the colours. A task owns a range of the grid's rows, so that results do not depend on the number of threads.

Rays and points are computed in float64: this costs little, and a camera far away loses no digits.
"""

from __future__ import annotations

import math

import numba
import numpy as np
import torch
from torch import Tensor

from hyrfpack.ops.background.reference import (
    BACKGROUND_RADIUS,
    BackgroundField,
    camera_rays,
    field_colors,
    grid_size,
)
from hyrfpack.ops.shade.directions import DIRECTION_FEATURES, FREQUENCY_OCTAVES
from hyrfpack.ops.viewport import Viewport
from hyrfpack.parallel.compiled import compiled
from hyrfpack.parallel.pool import run_ranges

_FAST_MATH = {"contract", "nsz"}
njit = compiled(fastmath=_FAST_MATH, error_model="numpy")
# Inlining is forced, so that cached kernels round like freshly compiled ones (see hyrfpack/ops/ssim/cpu.py).
inlined = numba.njit(fastmath=_FAST_MATH, error_model="numpy", forceinline=True)

_NODES_PER_BLOCK = 64  # The inputs of a block (8 KiB) then stay in the L1 cache.
_MIN_NODES_PER_TASK = 4096  # Fewer nodes are finished before another thread has started.

# Constants are typed, so that indices stay uint64 and values float32 in the kernels.
_BLOCK_STRIDE = np.uint64(_NODES_PER_BLOCK)
_U2 = np.uint64(2)
# Rows of a block's buffer: coordinates in the cube, then the direction, then its features.
_DIRECTION_ROW, _FEATURE_ROW = 3, 6
_BLOCK_ROWS = _FEATURE_ROW + max(DIRECTION_FEATURES.values())
# Taylor coefficients of sin(pi d / 2) / d and cos(pi d / 2) in d^2, for |d| <= 1. The errors are below 1e-9 there.
_TAYLOR = [(-1) ** (n // 2) * (math.pi / 2) ** n / math.factorial(n) for n in range(15)]
_S0, _S1, _S2, _S3, _S4, _S5, _S6 = _TAYLOR[1::2]
_C0, _C1, _C2, _C3, _C4, _C5, _C6, _C7 = _TAYLOR[::2]


@njit
def _find_nodes(start, stop, transmittance, threshold, stride, needed, counts):
    """Find the needed nodes from row `start` of the grid to before row `stop`, and count those of each row.

    Like torch's maximum, that of the pixels around a node is NaN if any of them is, and then exceeds nothing.
    """
    height, width = transmittance.shape
    largest = np.empty(width, np.float32)
    for row in range(start, stop):
        largest[:] = np.float32(0)
        for y in range(max(0, (row - 1) * stride + 1), min(height, (row + 1) * stride)):
            y = np.uint64(y)
            for x in range(width):
                x = np.uint64(x)
                light, before = transmittance[y, x], largest[x]
                largest[x] = light if (light > before) | (light != light) else before
        counts[row] = 0
        for column in range(needed.shape[1]):
            around = np.float32(0)
            for x in range(max(0, (column - 1) * stride + 1), min(width, (column + 1) * stride)):
                light = largest[np.uint64(x)]
                around = light if (light > around) | (light != light) else around
            needed[row, column] = around > threshold
            counts[row] += around > threshold


@inlined
def _cast_rays(row, places, count, rays, half_extent, block):
    """Compute directions, and contracted points of the sphere, of nodes of one row, as the reference does."""
    corner, right, down, origin = rays
    base_x, base_y, base_z = corner[0] + row * down[0], corner[1] + row * down[1], corner[2] + row * down[2]
    for k in range(count):
        k = np.uint64(k)
        place = places[k]
        x, y, z = base_x + place * right[0], base_y + place * right[1], base_z + place * right[2]
        length = math.sqrt(x * x + y * y + z * z)
        x, y, z = x / length, y / length, z / length
        along = x * origin[0] + y * origin[1] + z * origin[2]
        px, py, pz = origin[0] - along * x, origin[1] - along * y, origin[2] - along * z
        rest = math.sqrt(max(BACKGROUND_RADIUS * BACKGROUND_RADIUS - (px * px + py * py + pz * pz), 0.0))
        u, v, w = (
            (px + rest * x) / half_extent[0],
            (py + rest * y) / half_extent[1],
            (pz + rest * z) / half_extent[2],
        )
        radius = max(math.sqrt(u * u + v * v + w * w), 1.0)
        shrink = 0.25 * (2 - 1 / radius) / radius
        block[k] = shrink * u + 0.5
        block[k + _BLOCK_STRIDE] = shrink * v + 0.5
        block[k + _U2 * _BLOCK_STRIDE] = shrink * w + 0.5
        at = k + np.uint64(_DIRECTION_ROW) * _BLOCK_STRIDE
        block[at] = x
        block[at + _BLOCK_STRIDE] = y
        block[at + _U2 * _BLOCK_STRIDE] = z


@inlined
def _encode_frequencies(block, count):
    """Compute the features of `directions.frequency_encoding`: angles are doubled from one octave to the next."""
    for axis in range(3):
        source = np.uint64(_DIRECTION_ROW + axis) * _BLOCK_STRIDE
        sines = np.uint64(_FEATURE_ROW + axis) * _BLOCK_STRIDE
        cosines = sines + np.uint64(3 * FREQUENCY_OCTAVES) * _BLOCK_STRIDE
        for k in range(count):
            k = np.uint64(k)
            along = block[source + k]
            q = along * along
            sine = along * (_S0 + q * (_S1 + q * (_S2 + q * (_S3 + q * (_S4 + q * (_S5 + q * _S6))))))
            cosine = _C0 + q * (_C1 + q * (_C2 + q * (_C3 + q * (_C4 + q * (_C5 + q * (_C6 + q * _C7))))))
            for octave in range(FREQUENCY_OCTAVES):
                sine, cosine = 2 * sine * cosine, 1 - 2 * sine * sine
                octave_row = np.uint64(3 * octave) * _BLOCK_STRIDE
                block[sines + octave_row + k] = sine
                block[cosines + octave_row + k] = cosine


@inlined
def _encode_harmonics(block, count):
    """Compute the features of `directions.spherical_harmonics`."""
    source, target = np.uint64(_DIRECTION_ROW) * _BLOCK_STRIDE, np.uint64(_FEATURE_ROW) * _BLOCK_STRIDE
    for k in range(count):
        at = source + np.uint64(k)
        x, y, z = block[at], block[at + _BLOCK_STRIDE], block[at + _U2 * _BLOCK_STRIDE]
        at = target + np.uint64(k)
        block[at] = 0.28209479177387814
        block[at + _BLOCK_STRIDE] = 0.4886025119029199 * y
        block[at + np.uint64(2) * _BLOCK_STRIDE] = 0.4886025119029199 * z
        block[at + np.uint64(3) * _BLOCK_STRIDE] = 0.4886025119029199 * x
        block[at + np.uint64(4) * _BLOCK_STRIDE] = 1.0925484305920792 * x * y
        block[at + np.uint64(5) * _BLOCK_STRIDE] = 1.0925484305920792 * y * z
        block[at + np.uint64(6) * _BLOCK_STRIDE] = 0.31539156525252005 * (3 * z * z - 1)
        block[at + np.uint64(7) * _BLOCK_STRIDE] = 1.0925484305920792 * x * z
        block[at + np.uint64(8) * _BLOCK_STRIDE] = 0.5462742152960396 * (x * x - y * y)


@njit
def _encode_nodes(start, stop, needed, starts, rays, half_extent, is_frequency, nodes, coords, encoded):
    """List the needed nodes of rows `start` to before `stop`, with their coordinates (3, N) and features (E, N)."""
    columns = needed.shape[1]
    places = np.empty(columns, np.float64)
    block = np.empty(_BLOCK_ROWS * _NODES_PER_BLOCK, np.float64)
    for row in range(start, stop):
        count = 0
        for column in range(columns):
            if needed[row, column]:
                nodes[starts[row] + count] = row * columns + column
                places[count] = column
                count += 1
        for first in range(0, count, _NODES_PER_BLOCK):
            size = min(_NODES_PER_BLOCK, count - first)
            _cast_rays(row, places[first:], size, rays, half_extent, block)
            if is_frequency:
                _encode_frequencies(block, size)
            else:
                _encode_harmonics(block, size)
            target = np.uint64(starts[row] + first)
            for i in range(3):
                for k in range(size):
                    coords[np.uint64(i), target + np.uint64(k)] = block[np.uint64(i) * _BLOCK_STRIDE + np.uint64(k)]
            for i in range(encoded.shape[0]):
                source = np.uint64(_FEATURE_ROW + i) * _BLOCK_STRIDE
                for k in range(size):
                    encoded[np.uint64(i), target + np.uint64(k)] = block[source + np.uint64(k)]


def background_grid(
    transmittance: Tensor, viewport: Viewport, field: BackgroundField, *, threshold: float, stride: int
) -> Tensor:
    """Compute `hyrfpack.ops.background.background_grid`."""
    height, width = transmittance.shape
    rows, columns = grid_size(height, width, stride)
    min_rows = -(-_MIN_NODES_PER_TASK // columns)
    needed, counts = np.empty((rows, columns), np.bool_), np.empty(rows, np.int64)
    pixels = transmittance.detach().contiguous().numpy()
    limit = np.float32(threshold)
    run_ranges(lambda start, stop: _find_nodes(start, stop, pixels, limit, stride, needed, counts), rows, min_rows)
    starts = np.concatenate(([0], np.cumsum(counts)))
    colors = transmittance.new_zeros(rows * columns, 3)
    if total := int(starts[-1]):
        nodes = torch.empty(total, dtype=torch.int64)
        coords, encoded = colors.new_empty(3, total), colors.new_empty(DIRECTION_FEATURES[field.encoding], total)
        half_extent = tuple(float(half) for half in field.half_extent)
        arguments = needed, starts, camera_rays(viewport, stride), half_extent, field.encoding == "frequency"
        results = nodes.numpy(), coords.numpy(), encoded.numpy()
        run_ranges(lambda start, stop: _encode_nodes(start, stop, *arguments, *results), rows, min_rows)
        colors.index_copy_(0, nodes, field_colors(coords.T, encoded.T, field))
    return colors.view(rows, columns, 3)

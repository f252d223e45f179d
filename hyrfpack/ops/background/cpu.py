"""Computes the background at the nodes of a grid on the CPU.

Numba kernels find the nodes that are needed, and compute the field's inputs at each; the field's own kernels compute
the colours. A task owns a range of the grid's rows, so that results do not depend on the number of threads.

Rays and points are computed in float64: this costs little, and a camera far away loses no digits.
"""

from __future__ import annotations

import math
from functools import partial

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
from hyrfpack.ops.shade.cpu_directions import (
    BLOCK_ROWS,
    BLOCK_STRIDE,
    DIRECTION_ROW,
    FEATURE_ROW,
    POINTS_PER_BLOCK,
    encode_frequencies,
    encode_harmonics,
    inlined,
    njit,
)
from hyrfpack.ops.shade.directions import DIRECTION_FEATURES
from hyrfpack.ops.viewport import Viewport
from hyrfpack.parallel.pool import run_ranges

_MIN_NODES_PER_TASK = 4096  # Fewer nodes are finished before another thread has started.
# Inputs and activations of this many nodes take about 150 MB. More nodes are computed one part after another, unless
# gradients need all activations.
_MAX_PART_NODES = 1 << 17

# Constants are typed, so that indices stay uint64 and values float32 in the kernels.
_U2 = np.uint64(2)
# The rows of a block of directions are followed by the coordinates in the cube.
_COORDINATE_ROW = BLOCK_ROWS


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
        at = k + np.uint64(_COORDINATE_ROW) * BLOCK_STRIDE
        block[at] = shrink * u + 0.5
        block[at + BLOCK_STRIDE] = shrink * v + 0.5
        block[at + _U2 * BLOCK_STRIDE] = shrink * w + 0.5
        at = k + np.uint64(DIRECTION_ROW) * BLOCK_STRIDE
        block[at] = x
        block[at + BLOCK_STRIDE] = y
        block[at + _U2 * BLOCK_STRIDE] = z


@njit
def _encode_nodes(start, stop, needed, starts, rays, half_extent, is_frequency, nodes, coords, encoded):
    """List the needed nodes of rows `start` to before `stop`, with their coordinates (3, N) and features (E, N)."""
    columns = needed.shape[1]
    places = np.empty(columns, np.float64)
    block = np.empty((BLOCK_ROWS + 3) * POINTS_PER_BLOCK, np.float64)
    for row in range(start, stop):
        count = 0
        for column in range(columns):
            if needed[row, column]:
                nodes[starts[row] + count] = row * columns + column
                places[count] = column
                count += 1
        for first in range(0, count, POINTS_PER_BLOCK):
            size = min(POINTS_PER_BLOCK, count - first)
            _cast_rays(row, places[first:], size, rays, half_extent, block)
            if is_frequency:
                encode_frequencies(block, size)
            else:
                encode_harmonics(block, size)
            target = np.uint64(starts[row] + first)
            for i in range(3):
                source = np.uint64(_COORDINATE_ROW + i) * BLOCK_STRIDE
                for k in range(size):
                    coords[np.uint64(i), target + np.uint64(k)] = block[source + np.uint64(k)]
            for i in range(encoded.shape[0]):
                source = np.uint64(FEATURE_ROW + i) * BLOCK_STRIDE
                for k in range(size):
                    encoded[np.uint64(i), target + np.uint64(k)] = block[source + np.uint64(k)]


def background_grid(
    transmittance: Tensor,
    viewport: Viewport,
    field: BackgroundField,
    *,
    threshold: float,
    stride: int,
    needs_grad: bool,
) -> Tensor:
    """Compute `hyrfpack.ops.background.background_grid`; with `needs_grad` all nodes at once."""
    height, width = transmittance.shape
    rows, columns = grid_size(height, width, stride)
    min_rows = -(-_MIN_NODES_PER_TASK // columns)
    needed, counts = np.empty((rows, columns), np.bool_), np.empty(rows, np.int64)
    pixels = transmittance.detach().contiguous().numpy()
    limit = np.float32(threshold)
    run_ranges(lambda start, stop: _find_nodes(start, stop, pixels, limit, stride, needed, counts), rows, min_rows)
    starts = np.concatenate(([0], np.cumsum(counts)))
    colors = transmittance.new_zeros(rows * columns, 3)
    half_extent = tuple(float(half) for half in field.half_extent)
    arguments = camera_rays(viewport, stride), half_extent, field.encoding == "frequency"
    max_nodes = starts[-1] if needs_grad else max(_MAX_PART_NODES, columns)
    first = 0
    while starts[first] < starts[-1]:
        last = int(np.searchsorted(starts, starts[first] + max_nodes, side="right")) - 1
        nodes = torch.empty(int(starts[last] - starts[first]), dtype=torch.int64)
        coords = colors.new_empty(3, len(nodes))
        encoded = colors.new_empty(DIRECTION_FEATURES[field.encoding], len(nodes))
        arrays = nodes.numpy(), coords.numpy(), encoded.numpy()
        encode = partial(_encode_rows, first, needed, starts - starts[first], *arguments, *arrays)
        run_ranges(encode, last - first, min_rows)
        colors.index_copy_(0, nodes, field_colors(coords.T, encoded.T, field))
        first = last
    return colors.view(rows, columns, 3)


def _encode_rows(first, needed, starts, rays, half_extent, is_frequency, nodes, coords, encoded, start, stop) -> None:
    """Call `_encode_nodes` on rows that are counted from row `first`."""
    _encode_nodes(first + start, first + stop, needed, starts, rays, half_extent, is_frequency, nodes, coords, encoded)

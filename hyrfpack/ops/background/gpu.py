"""Computes the background at the nodes of a grid on a GPU.

Without gradients, one kernel computes colours from the transmittance. With gradients, one kernel finds the nodes that
are needed, and another computes the field's inputs at each; the field's own kernels compute the colours.

A program of the first kernel handles a block of neighbouring nodes, or returns early where no light passes. Neighbours
see neighbouring points of the sphere, so they mostly read the same rows of the tables. Hash features are therefore
tiles [level, node], and a warp's lanes are nodes. The decoder runs on the matrix units with nodes as rows, so that the
output of one layer enters the next without leaving the registers. The first layer is a sum of three products: one for
each of a level's two features, and one for the encoded direction.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import triton
import triton.language as tl
from torch import Tensor

from hyrfpack.ops.background.reference import (
    BACKGROUND_RADIUS,
    BackgroundField,
    camera_rays,
    field_colors,
    grid_size,
)
from hyrfpack.ops.contraction.gpu import contract_block
from hyrfpack.ops.gpu_pairs import unpack_pair
from hyrfpack.ops.gpu_rows import count_used_rows, partition_rows
from hyrfpack.ops.hash_encode.gpu import axis_vertices, level_parameters, rows_as_words, vertex_row
from hyrfpack.ops.mlp.tiles import multiply_add, pad_width, product_precision, round_factor, round_relu
from hyrfpack.ops.rows import place_rows
from hyrfpack.ops.shade.directions import DIRECTION_FEATURES
from hyrfpack.ops.shade.gpu_directions import encode_block
from hyrfpack.ops.viewport import Viewport

_NODE_ROWS_PER_BLOCK = tl.constexpr(8)
_NODES_PER_PROGRAM = 256  # This holds for `find_nodes_kernel` and `encode_nodes_kernel`, with one node per thread.
_BACKGROUND_RADIUS = tl.constexpr(BACKGROUND_RADIUS)
_CHANNELS = tl.constexpr(3)
_PADDED_CHANNELS = tl.constexpr(16)


class FieldTensors(NamedTuple):
    """The tensors of a `BackgroundField` as an argument of kernels.

    Attributes:
        table, levels: the results of `rows_as_words` and `level_parameters`.
        weights, biases: of the three layers.
    """

    table: Tensor
    levels: Tensor
    weights: tuple[Tensor, ...]
    biases: tuple[Tensor, ...]


class FieldSizes(NamedTuple):
    """The sizes of a `BackgroundField`, for which kernels are compiled.

    Attributes:
        LEVELS, ENCODING, H1, H2: numbers of levels, of features of a direction, and of neurons of both hidden layers.
        LEVELS_P, ENCODING_P, H1_P, H2_P: heights of the tiles that hold them, see `pad_width`.
        H2_SLICE: neurons of the second layer that are computed at once.
    """

    LEVELS: tl.constexpr
    ENCODING: tl.constexpr
    H1: tl.constexpr
    H2: tl.constexpr
    LEVELS_P: tl.constexpr
    ENCODING_P: tl.constexpr
    H1_P: tl.constexpr
    H2_P: tl.constexpr
    H2_SLICE: tl.constexpr


def _launch_shape(mixed: bool, hidden: int) -> tuple[int, int, int]:
    """Return the columns of nodes per block, the warps per block, and the neurons of the second layer per slice.

    Each thread handles one node, and registers limit the threads per multiprocessor. Wide layers and float32 factors
    need so many registers that several threads share a node. Every program loads all weights, which is about as much
    data as 128 nodes read from the tables.
    """
    if mixed:
        columns, warps, part = (16, 4, 64) if hidden <= 64 else (16, 8, 64)
    else:
        columns, warps, part = (8, 4, 32) if hidden <= 64 else (4, 8, 16)
    return columns, warps // 2 if torch.version.hip else warps, part


@triton.jit
def _sees_background(transmittance, height, width, y, x, threshold, stride, STRIDE: tl.constexpr):
    """Return whether the transmittance exceeds `threshold` at any pixel nearer to (y, x) than STRIDE in both axes."""
    sees_background = y < 0
    down = 1 - stride  # With a constant bound, compilers would unroll both loops and run out of registers.
    while down < stride:
        row = y + down
        for right in tl.static_range(1 - STRIDE, STRIDE):
            column = x + right
            inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
            light = tl.load(transmittance + row.to(tl.int64) * width + column, mask=inside, other=0.0)
            sees_background |= inside & (light > threshold)
        down += 1
    return sees_background


@triton.jit
def _load_3(pointer):
    return tl.load(pointer), tl.load(pointer + 1), tl.load(pointer + 2)


@triton.jit
def _cast_rays(i, j, rays, half_extent):
    """Return the contracted points where the rays of nodes (i, j) leave the sphere, and the rays' directions.

    `rays` is the result of `pack_rays`.
    """
    corner, right, down, origin = _load_3(rays), _load_3(rays + 3), _load_3(rays + 6), _load_3(rays + 9)
    row, column = i.to(tl.float32), j.to(tl.float32)
    x = corner[0] + row * down[0] + column * right[0]
    y = corner[1] + row * down[1] + column * right[1]
    z = corner[2] + row * down[2] + column * right[2]
    length = tl.sqrt_rn(x * x + y * y + z * z)
    x, y, z = tl.div_rn(x, length), tl.div_rn(y, length), tl.div_rn(z, length)
    # The computation follows `reference.sphere_points`.
    along = x * origin[0] + y * origin[1] + z * origin[2]
    px, py, pz = origin[0] - along * x, origin[1] - along * y, origin[2] - along * z
    outside = px * px + py * py + pz * pz - _BACKGROUND_RADIUS * _BACKGROUND_RADIUS
    rest = tl.sqrt_rn(tl.maximum(-outside, 0.0))
    px, py, pz = px + rest * x, py + rest * y, pz + rest * z
    u, v, w = contract_block(px / half_extent[0], py / half_extent[1], pz / half_extent[2])
    return u, v, w, x, y, z


@triton.jit
def _hash_features(x, y, z, table, levels, needed, LEVELS: tl.constexpr, HEIGHT: tl.constexpr):
    """Compute hash features of points [BLOCK] as two tiles [HEIGHT, BLOCK]; reads no rows for points not needed."""
    place = tl.arange(0, HEIGHT)[:, None]
    features0 = tl.zeros([HEIGHT, x.shape[0]], tl.float32)
    features1 = tl.zeros([HEIGHT, x.shape[0]], tl.float32)
    for level in range(LEVELS):
        span = tl.load(levels).to(tl.float32)
        x1, row_x0, row_x1 = axis_vertices(x, span, 1)
        y1, row_y0, row_y1 = axis_vertices(y, span, tl.load(levels + 1).to(tl.uint32))
        z1, row_z0, row_z1 = axis_vertices(z, span, tl.load(levels + 2).to(tl.uint32))
        mask, rows = tl.load(levels + 3).to(tl.uint32), table + tl.load(levels + 4)
        feature0, feature1 = tl.zeros_like(x), tl.zeros_like(x)
        for corner in tl.static_range(8):
            weight_x, row_x = (x1, row_x1) if corner & 1 else (1 - x1, row_x0)
            weight_y, row_y = (y1, row_y1) if corner & 2 else (1 - y1, row_y0)
            weight_z, row_z = (z1, row_z1) if corner & 4 else (1 - z1, row_z0)
            value0, value1 = unpack_pair(tl.load(rows + vertex_row(row_x, row_y, row_z, mask), mask=needed, other=0))
            weight = weight_x * (weight_y * weight_z)
            feature0 += weight * value0
            feature1 += weight * value1
        features0 = tl.where(place == level, feature0[None, :], features0)
        features1 = tl.where(place == level, feature1[None, :], features1)
        levels += 5
    return features0, features1


@triton.jit
def _load_weight(
    weight, start, INPUTS: tl.constexpr, FIRST: tl.constexpr, STEP: tl.constexpr, count,
    OUTPUTS: tl.constexpr, HEIGHT: tl.constexpr, WIDTH: tl.constexpr, PRECISION: tl.constexpr,
):  # fmt: skip
    """Load part of a weight matrix (OUTPUTS, INPUTS) as a transposed tile [HEIGHT, WIDTH], padded with zeros.

    The part has `count` columns FIRST, FIRST + STEP, ... and the rows start, start + 1, ...
    """
    row, column = tl.arange(0, HEIGHT)[:, None], start + tl.arange(0, WIDTH)[None, :]
    inside = (row < count) & (column < OUTPUTS)
    return round_factor(tl.load(weight + column * INPUTS + (FIRST + row * STEP), mask=inside, other=0.0), PRECISION)


@triton.jit
def _load_bias(bias, start, OUTPUTS: tl.constexpr, WIDTH: tl.constexpr, BLOCK: tl.constexpr):
    """Load elements start, start + 1, ... of a bias into every row of a tile [BLOCK, WIDTH], zero past its end."""
    column = start + tl.arange(0, WIDTH)[None, :]
    return tl.broadcast_to(tl.load(bias + column, mask=column < OUTPUTS, other=0.0), [BLOCK, WIDTH])


@triton.jit(do_not_specialize=["height", "width", "stride", "rows", "columns"])
def background_kernel(
    transmittance, height, width, threshold, stride, rows, columns, rays, half_extent, field, out,
    STRIDE: tl.constexpr, S: tl.constexpr, BLOCK_COLUMNS: tl.constexpr, FREQUENCY: tl.constexpr,
    PRECISION: tl.constexpr,
):  # fmt: skip
    """Write the colours of a block of nodes to `out` (3, rows, columns).

    `rays` is the result of `pack_rays`, half_extent a tuple, `field` `FieldTensors` and S `FieldSizes`. Sizes of the
    picture are not put into tuples, because Triton would compile another kernel for each that is 1 or a multiple of 16.
    """
    w1, w2, w3 = field.weights
    b1, b2, b3 = field.biases
    BLOCK: tl.constexpr = _NODE_ROWS_PER_BLOCK * BLOCK_COLUMNS
    INPUTS: tl.constexpr = 2 * S.LEVELS + S.ENCODING
    blocks = tl.cdiv(columns, BLOCK_COLUMNS)
    lane = tl.arange(0, BLOCK)
    i = tl.program_id(0) // blocks * _NODE_ROWS_PER_BLOCK + lane // BLOCK_COLUMNS
    j = tl.program_id(0) % blocks * BLOCK_COLUMNS + lane % BLOCK_COLUMNS
    inside = (i < rows) & (j < columns)
    needed = inside & _sees_background(transmittance, height, width, i * STRIDE, j * STRIDE, threshold, stride, STRIDE)
    colors = tl.zeros([BLOCK, _PADDED_CHANNELS], tl.float32)
    if tl.max(needed.to(tl.int32), 0) > 0:
        u, v, w, x, y, z = _cast_rays(i, j, rays, half_extent)
        features0, features1 = _hash_features(u, v, w, field.table, field.levels, needed, S.LEVELS, S.LEVELS_P)

        hidden = _load_bias(b1, 0, S.H1, S.H1_P, BLOCK)
        weight = _load_weight(w1, 0, INPUTS, 0, 2, S.LEVELS, S.H1, S.LEVELS_P, S.H1_P, PRECISION)
        hidden = multiply_add(tl.trans(round_factor(features0, PRECISION)), weight, hidden, PRECISION)
        weight = _load_weight(w1, 0, INPUTS, 1, 2, S.LEVELS, S.H1, S.LEVELS_P, S.H1_P, PRECISION)
        hidden = multiply_add(tl.trans(round_factor(features1, PRECISION)), weight, hidden, PRECISION)
        weight = _load_weight(w1, 0, INPUTS, 2 * S.LEVELS, 1, S.ENCODING, S.H1, S.ENCODING_P, S.H1_P, PRECISION)
        encoded = round_factor(encode_block(x, y, z, FREQUENCY, 0, S.ENCODING_P), PRECISION)
        hidden = round_relu(multiply_add(tl.trans(encoded), weight, hidden, PRECISION), PRECISION)

        logits = _load_bias(b3, 0, _CHANNELS, _PADDED_CHANNELS, BLOCK)
        for start in range(0, S.H2_P, S.H2_SLICE):
            second = _load_weight(w2, start, S.H1, 0, 1, S.H1, S.H2, S.H1_P, S.H2_SLICE, PRECISION)
            part = round_relu(
                multiply_add(hidden, second, _load_bias(b2, start, S.H2, S.H2_SLICE, BLOCK), PRECISION), PRECISION
            )
            third = _load_weight(
                w3 + start, 0, S.H2, 0, 1, S.H2 - start, _CHANNELS, S.H2_SLICE, _PADDED_CHANNELS, PRECISION
            )
            logits = multiply_add(part, third, logits, PRECISION)
        colors = tl.where(needed[:, None], tl.sigmoid(logits), 0.0)
    channel = tl.arange(0, _PADDED_CHANNELS)[None, :]
    at = out + (channel.to(tl.int64) * rows + i[:, None]) * columns + j[:, None]
    tl.store(at, colors, mask=inside[:, None] & (channel < _CHANNELS))


def pack_rays(viewport: Viewport, stride: int, device: torch.device) -> Tensor:
    """Pack the result of `camera_rays` into one tensor (12,) float32 on the device, if the camera is not packed."""
    if viewport.packed is not None:
        return viewport.packed.rays
    numbers = [number for vector in camera_rays(viewport, stride) for number in vector]
    # A blocking copy would wait for the device. This one stages its source at once, so the source may be freed.
    return torch.tensor(numbers, dtype=torch.float32).to(device, non_blocking=True)


def background_grid(
    transmittance: Tensor, viewport: Viewport, field: BackgroundField, *, threshold: float, stride: int
) -> Tensor:
    """Compute `hyrfpack.ops.background.background_grid` without gradients, for a field that "gpu" supports."""
    height, width = transmittance.shape
    rows, columns = grid_size(height, width, stride)
    weights, biases = (
        tuple(tensor.detach().contiguous() for tensor in layers) for layers in (field.weights, field.biases)
    )
    levels = level_parameters(field.resolutions, field.log2_table_size, field.table.device)
    hidden = [len(bias) for bias in biases[:2]]
    sizes = [len(field.resolutions), weights[0].shape[1] - 2 * len(field.resolutions), *hidden]
    widths = [pad_width(width) for width in hidden]
    block_columns, warps, part = _launch_shape(field.mixed, max(widths))
    colors = field.table.new_empty((3, rows, columns))
    background_kernel[(triton.cdiv(rows, _NODE_ROWS_PER_BLOCK.value) * triton.cdiv(columns, block_columns),)](
        transmittance.detach().contiguous(),
        height,
        width,
        threshold,
        stride,
        rows,
        columns,
        pack_rays(viewport, stride, field.table.device),
        tuple(field.half_extent),
        FieldTensors(rows_as_words(field.table), levels, weights, biases),
        colors,
        STRIDE=stride,
        S=FieldSizes(*map(tl.constexpr, (*sizes, *map(pad_width, sizes), min(widths[1], part)))),
        BLOCK_COLUMNS=block_columns,
        FREQUENCY=field.encoding == "frequency",
        PRECISION=product_precision(field.mixed),
        num_warps=warps,
        enable_fp_fusion=True,
    )
    return colors.permute(1, 2, 0)


@triton.jit(do_not_specialize=["height", "width", "stride", "columns", "total"])
def find_nodes_kernel(
    transmittance, height, width, threshold, stride, columns, total, needed, STRIDE: tl.constexpr, BLOCK: tl.constexpr
):
    """Write whether each node is needed, (total,) uint8."""
    node = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    y, x = node // columns * STRIDE, node % columns * STRIDE
    sees_background = _sees_background(transmittance, height, width, y, x, threshold, stride, STRIDE)
    tl.store(needed + node, sees_background.to(tl.uint8), mask=node < total)


@triton.jit(do_not_specialize=["columns", "total"])
def encode_nodes_kernel(
    nodes, columns, total, used, rays, half_extent, coords, encoded,
    ENCODING_WIDTH: tl.constexpr, FREQUENCY: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Write the field's inputs at `nodes` (total,) int64, of which `used` are in use.

    They are planar coords (3, total) and encoded directions (ENCODING_WIDTH, total).
    """
    index = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    live = index < count_used_rows(used, total)
    node = tl.load(nodes + index, mask=live, other=0).to(tl.int32)
    u, v, w, x, y, z = _cast_rays(node // columns, node % columns, rays, half_extent)
    tl.store(coords + index, u, mask=live)
    tl.store(coords + total + index, v, mask=live)
    tl.store(coords + 2 * total.to(tl.int64) + index, w, mask=live)
    for first in tl.static_range(0, ENCODING_WIDTH, 16):
        row = first + tl.arange(0, 16)[:, None]
        tile = encode_block(x, y, z, FREQUENCY, first, 16)
        tl.store(encoded + row.to(tl.int64) * total + index[None, :], tile, mask=live[None, :] & (row < ENCODING_WIDTH))


def differentiable_grid(
    transmittance: Tensor, viewport: Viewport, field: BackgroundField, *, threshold: float, stride: int
) -> Tensor:
    """Compute `hyrfpack.ops.background.background_grid`, differentiable in the field's parameters.

    All nodes get memory, so that the host need not wait for the number of needed ones.
    """
    height, width = transmittance.shape
    rows, columns = grid_size(height, width, stride)
    total = rows * columns
    needed = torch.empty(total, dtype=torch.uint8, device=transmittance.device)
    find_nodes_kernel[(triton.cdiv(total, _NODES_PER_PROGRAM),)](
        transmittance.detach().contiguous(), height, width, threshold, stride, columns, total, needed,
        STRIDE=stride, BLOCK=_NODES_PER_PROGRAM, num_warps=4, enable_fp_fusion=True,
    )  # fmt: skip
    nodes, used = partition_rows(needed, torch.cumsum(needed, 0, dtype=torch.int64), total)
    coords = transmittance.new_empty(3, total)
    encoded = transmittance.new_empty(DIRECTION_FEATURES[field.encoding], total)
    encode_nodes_kernel[(triton.cdiv(total, _NODES_PER_PROGRAM),)](
        nodes, columns, total, used, pack_rays(viewport, stride, coords.device), tuple(field.half_extent),
        coords, encoded,
        ENCODING_WIDTH=len(encoded), FREQUENCY=field.encoding == "frequency", BLOCK=_NODES_PER_PROGRAM,
        num_warps=4, enable_fp_fusion=True,
    )  # fmt: skip
    colors = field_colors(coords.T, encoded.T, field, used)
    return place_rows(colors, nodes, used, total).view(rows, columns, 3)

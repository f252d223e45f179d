"""The background at the nodes of a grid on a GPU: one kernel from the light that is left to colours. Where gradients
are wanted, one kernel finds the nodes that are needed and another what the field is asked at each; the field's own
kernels do the rest.

A program of the first does a block of neighbouring nodes, or nothing where no light passes. Neighbours look at
neighbouring points of the sphere and so mostly read the same rows of the tables: hash features are tiles [level, node],
and a warp's lanes are nodes. The decoder runs on the matrix units with nodes as rows, so that what comes out of one
layer goes into the next without leaving the registers. A level's two features are two tiles, and with the direction's
three products make the first layer.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import triton
import triton.language as tl
from torch import Tensor

from hyrfpack.ops.background.reference import RADIUS, field_colors, grid_size
from hyrfpack.ops.contraction.gpu import contract_block
from hyrfpack.ops.gpu_pairs import unpack_pair
from hyrfpack.ops.hash_encode.gpu import axis_vertices, level_numbers, vertex_row, whole_rows
from hyrfpack.ops.mlp.tiles import factor, precision, product, relu_factor
from hyrfpack.ops.poses import camera_center
from hyrfpack.ops.shade.directions import DIRECTION_FEATURES
from hyrfpack.ops.shade.gpu_directions import encode_block

_BLOCK_ROWS = tl.constexpr(8)
_NODES = 256  # of a program that does one thing for each
_RADIUS, _OUTPUTS, _OUTPUTS_P = tl.constexpr(RADIUS), tl.constexpr(3), tl.constexpr(16)


def _launch(mixed: bool, hidden: int) -> tuple[int, int, int]:
    """Columns of nodes in a block, its warps, and neurons of the second layer that are worked out together.

    A thread has a node, and as many threads share a multiprocessor as registers allow. Wide layers and float32 factors
    take so many of them that several threads share a node. The weights, which every program loads, are about as much
    as what 128 nodes read of the tables.
    """
    if mixed:
        columns, warps, part = (16, 4, 64) if hidden <= 64 else (16, 8, 64)
    else:
        columns, warps, part = (8, 4, 32) if hidden <= 64 else (4, 8, 16)
    return columns, warps // 2 if torch.version.hip else warps, part


@triton.jit
def _light(transmittance, height, width, y, x, threshold, stride, STRIDE: tl.constexpr):
    """Whether more light than `threshold` passes at any pixel nearer to (y, x) than STRIDE in both axes."""
    lit = y < 0
    down = 1 - stride  # not a constant, lest compilers unroll both loops and run out of registers
    while down < stride:
        row = y + down
        for right in tl.static_range(1 - STRIDE, STRIDE):
            column = x + right
            inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
            light = tl.load(transmittance + row.to(tl.int64) * width + column, mask=inside, other=0.0)
            lit |= inside & (light > threshold)
        down += 1
    return lit


@triton.jit
def _look(i, j, rays, half_extent):
    """Where in the cube the rays of nodes (i, j) leave the sphere, and their directions; rays as of `_rays`."""
    corner, right, down, origin = rays
    row, column = i.to(tl.float32), j.to(tl.float32)
    x = corner[0] + row * down[0] + column * right[0]
    y = corner[1] + row * down[1] + column * right[1]
    z = corner[2] + row * down[2] + column * right[2]
    length = tl.sqrt_rn(x * x + y * y + z * z)
    x, y, z = tl.div_rn(x, length), tl.div_rn(y, length), tl.div_rn(z, length)
    # `reference.sphere_points`.
    along = x * origin[0] + y * origin[1] + z * origin[2]
    px, py, pz = origin[0] - along * x, origin[1] - along * y, origin[2] - along * z
    outside = px * px + py * py + pz * pz - _RADIUS * _RADIUS
    rest = tl.sqrt_rn(tl.maximum(-outside, 0.0))
    px, py, pz = px + rest * x, py + rest * y, pz + rest * z
    u, v, w = contract_block(px / half_extent[0], py / half_extent[1], pz / half_extent[2])
    return u, v, w, x, y, z


@triton.jit
def _features(x, y, z, table, levels, needed, LEVELS: tl.constexpr, HEIGHT: tl.constexpr):
    """Hash features of points [BLOCK] as two tiles [HEIGHT, BLOCK]; no row is read where a point is not needed."""
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
def _weight(
    weight, start, INPUTS: tl.constexpr, FIRST: tl.constexpr, STEP: tl.constexpr, count,
    OUTPUTS: tl.constexpr, HEIGHT: tl.constexpr, WIDTH: tl.constexpr, PRECISION: tl.constexpr,
):  # fmt: skip
    """Of a weight (OUTPUTS, INPUTS), columns FIRST, FIRST + STEP, ... (count of them) and rows start, start + 1, ... as
    a transposed tile [HEIGHT, WIDTH], zero around."""
    row, column = tl.arange(0, HEIGHT)[:, None], start + tl.arange(0, WIDTH)[None, :]
    inside = (row < count) & (column < OUTPUTS)
    return factor(tl.load(weight + column * INPUTS + (FIRST + row * STEP), mask=inside, other=0.0), PRECISION)


@triton.jit
def _bias(bias, start, OUTPUTS: tl.constexpr, WIDTH: tl.constexpr, BLOCK: tl.constexpr):
    """Numbers start, start + 1, ... of a bias as rows of a tile [BLOCK, WIDTH], zero past its end."""
    column = start + tl.arange(0, WIDTH)[None, :]
    return tl.broadcast_to(tl.load(bias + column, mask=column < OUTPUTS, other=0.0), [BLOCK, WIDTH])


@triton.jit(do_not_specialize=["height", "width", "stride", "rows", "columns"])
def draw_nodes(
    transmittance, height, width, threshold, stride, rows, columns, rays, half_extent, table, levels, weights, biases,
    out,
    STRIDE: tl.constexpr, LEVELS: tl.constexpr, EXTRA: tl.constexpr, H1: tl.constexpr, H2: tl.constexpr,
    LEVELS_P: tl.constexpr, EXTRA_P: tl.constexpr, H1_P: tl.constexpr, H2_P: tl.constexpr, PART: tl.constexpr,
    BLOCK_COLUMNS: tl.constexpr, FREQUENCY: tl.constexpr, PRECISION: tl.constexpr,
):  # fmt: skip
    """Colours of a block of nodes.

    Tuples: rays of `_rays`, half_extent, weights and biases of the three layers. Whole numbers stay out of them, for
    there Triton builds a kernel for each that is 1 or a multiple of 16.
    """
    w1, w2, w3 = weights
    b1, b2, b3 = biases
    BLOCK: tl.constexpr = _BLOCK_ROWS * BLOCK_COLUMNS
    INPUTS: tl.constexpr = 2 * LEVELS + EXTRA
    blocks = tl.cdiv(columns, BLOCK_COLUMNS)
    lane = tl.arange(0, BLOCK)
    i = tl.program_id(0) // blocks * _BLOCK_ROWS + lane // BLOCK_COLUMNS
    j = tl.program_id(0) % blocks * BLOCK_COLUMNS + lane % BLOCK_COLUMNS
    inside = (i < rows) & (j < columns)
    needed = inside & _light(transmittance, height, width, i * STRIDE, j * STRIDE, threshold, stride, STRIDE)
    colors = tl.zeros([BLOCK, _OUTPUTS_P], tl.float32)
    if tl.max(needed.to(tl.int32), 0) > 0:
        u, v, w, x, y, z = _look(i, j, rays, half_extent)
        features0, features1 = _features(u, v, w, table, levels, needed, LEVELS, LEVELS_P)

        hidden = _bias(b1, 0, H1, H1_P, BLOCK)
        weight = _weight(w1, 0, INPUTS, 0, 2, LEVELS, H1, LEVELS_P, H1_P, PRECISION)
        hidden = product(tl.trans(factor(features0, PRECISION)), weight, hidden, PRECISION)
        weight = _weight(w1, 0, INPUTS, 1, 2, LEVELS, H1, LEVELS_P, H1_P, PRECISION)
        hidden = product(tl.trans(factor(features1, PRECISION)), weight, hidden, PRECISION)
        weight = _weight(w1, 0, INPUTS, 2 * LEVELS, 1, EXTRA, H1, EXTRA_P, H1_P, PRECISION)
        encoded = factor(encode_block(x, y, z, FREQUENCY, 0, EXTRA_P), PRECISION)
        hidden = relu_factor(product(tl.trans(encoded), weight, hidden, PRECISION), PRECISION)

        logits = _bias(b3, 0, _OUTPUTS, _OUTPUTS_P, BLOCK)
        for start in range(0, H2_P, PART):
            second = _weight(w2, start, H1, 0, 1, H1, H2, H1_P, PART, PRECISION)
            part = relu_factor(product(hidden, second, _bias(b2, start, H2, PART, BLOCK), PRECISION), PRECISION)
            third = _weight(w3 + start, 0, H2, 0, 1, H2 - start, _OUTPUTS, PART, _OUTPUTS_P, PRECISION)
            logits = product(part, third, logits, PRECISION)
        colors = tl.where(needed[:, None], tl.sigmoid(logits), 0.0)
    channel = tl.arange(0, _OUTPUTS_P)[None, :]
    at = out + (channel.to(tl.int64) * rows + i[:, None]) * columns + j[:, None]
    tl.store(at, colors, mask=inside[:, None] & (channel < _OUTPUTS))


def background_grid(
    transmittance: Tensor,
    threshold: float,
    stride: int,
    pose: Tensor,
    intrinsics: tuple[float, float, float, float],
    half_extent: tuple[float, float, float],
    table: Tensor,
    resolutions: tuple[int, ...],
    log2_table_size: int,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor],
    encoding: str,
    mixed: bool,
) -> Tensor:
    """As `hyrfpack.ops.background.background_grid`, of a field that fits and with no gradients."""
    height, width = transmittance.shape
    rows, columns = grid_size(height, width, stride)
    weights, biases = (tuple(tensor.detach().contiguous() for tensor in layers) for layers in (weights, biases))
    levels, extra = len(resolutions), weights[0].shape[1] - 2 * len(resolutions)
    hidden = [len(bias) for bias in biases[:2]]
    widths = [_padded(width) for width in hidden]
    block_columns, warps, part = _launch(mixed, max(widths))
    colors = table.new_empty((3, rows, columns))
    draw_nodes[(triton.cdiv(rows, _BLOCK_ROWS.value) * triton.cdiv(columns, block_columns),)](
        transmittance.detach().contiguous(),
        height,
        width,
        threshold,
        stride,
        rows,
        columns,
        _rays(pose, intrinsics, stride),
        tuple(half_extent),
        whole_rows(table),
        level_numbers(resolutions, log2_table_size, table.device),
        weights,
        biases,
        colors,
        STRIDE=stride,
        LEVELS=levels,
        EXTRA=extra,
        H1=hidden[0],
        H2=hidden[1],
        LEVELS_P=_padded(levels),
        EXTRA_P=_padded(extra),
        H1_P=widths[0],
        H2_P=widths[1],
        PART=min(widths[1], part),
        BLOCK_COLUMNS=block_columns,
        FREQUENCY=encoding == "frequency",
        PRECISION=precision(mixed),
        num_warps=warps,
        enable_fp_fusion=True,
    )
    return colors.permute(1, 2, 0)


@triton.jit(do_not_specialize=["height", "width", "stride", "columns", "total"])
def find_nodes(
    transmittance, height, width, threshold, stride, columns, total, needed, STRIDE: tl.constexpr, BLOCK: tl.constexpr
):
    """Write which of the nodes are needed, (total,) uint8."""
    node = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    y, x = node // columns * STRIDE, node % columns * STRIDE
    lit = _light(transmittance, height, width, y, x, threshold, stride, STRIDE)
    tl.store(needed + node, lit.to(tl.uint8), mask=node < total)


@triton.jit(do_not_specialize=["columns", "total"])
def look_from_nodes(
    nodes, columns, total, rays, half_extent, coords, encoded,
    EXTRA: tl.constexpr, FREQUENCY: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Write what the field is asked at nodes (total,) int64: coords planar (3, total), directions (EXTRA, total)."""
    index = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    live = index < total
    node = tl.load(nodes + index, mask=live, other=0).to(tl.int32)
    u, v, w, x, y, z = _look(node // columns, node % columns, rays, half_extent)
    tl.store(coords + index, u, mask=live)
    tl.store(coords + total + index, v, mask=live)
    tl.store(coords + 2 * total.to(tl.int64) + index, w, mask=live)
    for first in tl.static_range(0, EXTRA, 16):
        row = first + tl.arange(0, 16)[:, None]
        tile = encode_block(x, y, z, FREQUENCY, first, 16)
        tl.store(encoded + row.to(tl.int64) * total + index[None, :], tile, mask=live[None, :] & (row < EXTRA))


def learnable_grid(
    transmittance: Tensor,
    threshold: float,
    stride: int,
    pose: Tensor,
    intrinsics: tuple[float, float, float, float],
    half_extent: tuple[float, float, float],
    encoding: str,
    **field,
) -> Tensor:
    """As `hyrfpack.ops.background.background_grid`, differentiable in the field; `field` is what `field_colors` takes.

    Waits for the device once, to learn how many nodes there are.
    """
    height, width = transmittance.shape
    rows, columns = grid_size(height, width, stride)
    needed = torch.empty(rows * columns, dtype=torch.uint8, device=transmittance.device)
    find_nodes[(triton.cdiv(rows * columns, _NODES),)](
        transmittance.detach().contiguous(), height, width, threshold, stride, columns, rows * columns, needed,
        STRIDE=stride, BLOCK=_NODES, num_warps=4, enable_fp_fusion=True,
    )  # fmt: skip
    nodes = torch.nonzero(needed).squeeze(-1)
    colors = transmittance.new_zeros(3, rows * columns)
    if total := len(nodes):
        coords, encoded = colors.new_empty(3, total), colors.new_empty(DIRECTION_FEATURES[encoding], total)
        look_from_nodes[(triton.cdiv(total, _NODES),)](
            nodes, columns, total, _rays(pose, intrinsics, stride), tuple(half_extent), coords, encoded,
            EXTRA=len(encoded), FREQUENCY=encoding == "frequency", BLOCK=_NODES, num_warps=4, enable_fp_fusion=True,
        )  # fmt: skip
        colors.index_copy_(1, nodes, field_colors(coords.T, encoded.T, **field).T)
    return colors.view(3, rows, columns).permute(1, 2, 0)


def _rays(pose: Tensor, intrinsics: tuple[float, float, float, float], stride: int) -> tuple[tuple[float, ...], ...]:
    """The first node's ray, its steps from column to column and from row to row, and the origin, of 3 numbers each."""
    fx, fy, cx, cy = intrinsics
    pose = pose.detach().cpu().double()
    seen = [[(0.5 - cx) / fx, (0.5 - cy) / fy, 1], [stride / fx, 0, 0], [0, stride / fy, 0]]
    rays = torch.tensor(seen, dtype=torch.float64) @ pose[:3, :3]
    return tuple(map(tuple, (*rays.tolist(), camera_center(pose).tolist())))


def _padded(width: int) -> int:
    """The side of a tile that holds this many numbers; the matrix units take no less than 16."""
    return max(16, triton.next_power_of_2(width))

"""Evaluates the multilayer perceptron on a GPU: two hidden layers in one kernel, on the matrix units.

Points are columns: a block of them is a tile [width, BLOCK], so planar features load without a transpose. The kernels
are persistent: a fixed number of programs loop over all blocks, each with a stride of the number of programs. Hidden
activations never leave the chip; backward recomputes them. Each program sums its own gradients of weights and biases,
and torch sums those of all programs. There are no atomics, so all runs on one machine give the same bytes.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import torch
import triton
import triton.language as tl
from torch import Tensor

from hyrfpack.ops.dispatch import is_interpreting
from hyrfpack.ops.gpu_rows import count_used_rows
from hyrfpack.ops.mlp.tiles import (
    kernel_widths,
    linear,
    load_tile_transposed,
    multiply_add,
    pack_weights,
    pad_width,
    product_precision,
    round_factor,
    round_relu,
)

# The registers of a multiprocessor suffice for this many programs at once.
_FORWARD_PROGRAMS_PER_PROCESSOR = 4
_BACKWARD_PROGRAMS_PER_PROCESSOR = 2
# Larger blocks would leave too few registers for the other resident programs (mixed) or would spill (float32).
_FORWARD_POINTS_PER_BLOCK_MIXED = 128
_FORWARD_POINTS_PER_BLOCK_FLOAT32 = 32


class Rows(NamedTuple):
    """A matrix of points and features as an argument of kernels."""

    data: Tensor
    point_stride: int
    feature_stride: int


def forward(
    x: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor], mixed: bool, used: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Compute the outputs (N, O) of rows (N, I), and the packed weights for `backward`."""
    widths = [x.shape[1], *(weight.shape[0] for weight in weights)]
    multiplication = product_precision(mixed)
    packed = pack_weights(weights, multiplication)
    result = x.new_empty(x.shape[0], widths[-1])
    block = _FORWARD_POINTS_PER_BLOCK_MIXED if mixed else _FORWARD_POINTS_PER_BLOCK_FLOAT32
    programs = _program_count(x, block, _FORWARD_PROGRAMS_PER_PROCESSOR)
    if programs:
        forward_kernel[(programs,)](
            Rows(x, *x.stride()),
            packed,
            tuple(bias.contiguous() for bias in biases),
            result,
            x.shape[0],
            used,
            W=kernel_widths(widths),
            PLANAR=x.stride(0) == 1,
            NEEDS_INT64=_needs_int64_offsets(x),
            BLOCK=block,
            PRECISION=multiplication,
            num_warps=_warps_per_program(widths, multiplication),
            enable_fp_fusion=True,
        )
    return result, packed


def backward(
    x: Tensor,
    packed: Tensor,
    biases: Sequence[Tensor],
    widths: Sequence[int],
    grad: Tensor,
    needs_x: bool,
    mixed: bool,
    used: Tensor | None = None,
) -> tuple[Tensor | None, list[Tensor], list[Tensor]]:
    """Compute the gradients of x, weights and biases from the gradient (N, O) of the outputs.

    Args:
        packed: the packed weights that `forward` returned.
        biases: as in `forward`; the last one is not used.
        widths: widths of the inputs, the hidden layers and the outputs.
        needs_x: whether to compute the gradient of x; otherwise it is None.

    Returns:
        The gradients of x, in its layout, of the weights and of the biases.
    """
    multiplication = product_precision(mixed)
    planar = x.stride(0) == 1
    grad_x = None
    if needs_x:
        grad_x = x.new_empty(x.shape[1], x.shape[0]).T if planar else torch.empty_like(x)
    inputs, hidden1, hidden2, outputs = widths
    lengths = [hidden1 * inputs, hidden2 * hidden1, outputs * hidden2, hidden1, hidden2, outputs]
    block = _backward_points_per_block(multiplication, x.device)
    programs = _program_count(x, block, _BACKWARD_PROGRAMS_PER_PROCESSOR)
    partials = x.new_empty(programs, sum(lengths))
    launches = [{"UPPER_LAYERS": True, "FIRST_LAYER": True, "NEEDS_X": needs_x}]
    if multiplication == "tf32x3":  # Products hold three times as many factors, so one kernel for all would spill.
        launches = [{name: name == part for name in launches[0]} for part, needed in launches[0].items() if needed]
    written = x if grad_x is None else grad_x
    for launch in launches if programs else []:
        backward_kernel[(programs,)](
            Rows(x, *x.stride()),
            packed,
            tuple(bias.contiguous() for bias in biases[:2]),
            Rows(grad, *grad.stride()),
            Rows(written, *written.stride()),
            partials,
            x.shape[0],
            used,
            W=kernel_widths(widths),
            **launch,
            PLANAR=planar,
            NEEDS_INT64=_needs_int64_offsets(x) or _needs_int64_offsets(grad),
            BLOCK=block,
            PRECISION=multiplication,
            num_warps=_warps_per_program(widths, multiplication),
            enable_fp_fusion=True,
        )
    w1, w2, w3, b1, b2, b3 = partials.sum(0).split(lengths)
    return (
        grad_x,
        [w1.view(hidden1, inputs), w2.view(hidden2, hidden1), w3.view(outputs, hidden2)],
        [b1, b2, b3],
    )


def _warps_per_program(widths: Sequence[int], multiplication: str) -> int:
    """Return the warps per program; wide layers need the registers of twice as many threads.

    Triton 3.6 reads past the end of shared memory on an H200 where eight warps multiply a tile of 64 rows in tf32x3.
    """
    heights = [pad_width(width) for width in widths[:3]]
    shares_rows = multiplication == "tf32x3" and min(heights[1:]) <= 64
    return 8 if max(heights) > 64 and not shares_rows else 4


@cache
def _backward_points_per_block(product_precision: str, device: torch.device) -> int:
    """Return the points per block of the backward pass: the most that do not spill registers on this device.

    Matrix units that read a factor from shared memory (compute capability 9 and 10) leave registers for more points.
    """
    if is_interpreting():
        return 32
    reads_shared = not torch.version.hip and torch.cuda.get_device_capability(device)[0] in (9, 10)
    return 32 if reads_shared and product_precision == "bf16" else 16


def _program_count(x: Tensor, block: int, programs_per_processor: int) -> int:
    """Return the number of programs to launch for the rows of x."""
    return min(triton.cdiv(x.shape[0], block), programs_per_processor * _multiprocessor_count(x.device))


@cache
def _multiprocessor_count(device: torch.device) -> int:
    """Return the number of multiprocessors of a device; 1 in Triton's interpreter."""
    return 1 if device.type == "cpu" else torch.cuda.get_device_properties(device).multi_processor_count


def _needs_int64_offsets(x: Tensor) -> bool:
    """Return whether offsets between features may exceed 32 bits."""
    return abs(x.stride(1)) * x.shape[1] >= 2**31


@triton.jit
def _offsets(stride_point, stride_feature, HEIGHT: tl.constexpr, BLOCK: tl.constexpr, NEEDS_INT64: tl.constexpr):
    """Return the offsets of a tile [HEIGHT, BLOCK] of features and points."""
    feature, point = tl.arange(0, HEIGHT)[:, None], tl.arange(0, BLOCK)[None, :]
    if NEEDS_INT64:
        feature = feature.to(tl.int64)
    return feature * stride_feature + point * stride_point


@triton.jit
def _tile_mask(start, count, WIDTH: tl.constexpr, HEIGHT: tl.constexpr, BLOCK: tl.constexpr):
    """Return the mask of a tile [HEIGHT, BLOCK]: features below WIDTH of points below `count`."""
    return (tl.arange(0, HEIGHT)[:, None] < WIDTH) & (tl.arange(0, BLOCK)[None, :] < count - start)


@triton.jit
def _load_tile(
    x, stride_point, stride_feature, start, count,
    WIDTH: tl.constexpr, HEIGHT: tl.constexpr, BLOCK: tl.constexpr, NEEDS_INT64: tl.constexpr,
):  # fmt: skip
    """Load rows start, start + 1, ... of x (count, WIDTH) as a tile [HEIGHT, BLOCK], zero outside."""
    x += start.to(tl.int64) * stride_point
    offsets = _offsets(stride_point, stride_feature, HEIGHT, BLOCK, NEEDS_INT64)
    return tl.load(x + offsets, mask=_tile_mask(start, count, WIDTH, HEIGHT, BLOCK), other=0.0)


@triton.jit
def _store_tile(
    tile, x, stride_point, stride_feature, start, count,
    WIDTH: tl.constexpr, HEIGHT: tl.constexpr, BLOCK: tl.constexpr, NEEDS_INT64: tl.constexpr,
):  # fmt: skip
    """Store a tile to rows start, start + 1, ... of x, the inverse of `_load_tile`."""
    x += start.to(tl.int64) * stride_point
    offsets = _offsets(stride_point, stride_feature, HEIGHT, BLOCK, NEEDS_INT64)
    tl.store(x + offsets, tile, mask=_tile_mask(start, count, WIDTH, HEIGHT, BLOCK))


@triton.jit
def _opaque_zero(start, count):
    """Return a zero that the compiler cannot fold into a constant.

    Added to a stride, it prevents the compiler from hoisting the addresses of a tile out of the loop over blocks. These
    would take 64 bits of registers for every element of the tile that a thread loads.
    """
    return tl.minimum(count - start - 1, 0)


@triton.jit(do_not_specialize=["count"])
def forward_kernel(
    x, packed, biases, y, count, used,
    W: tl.constexpr, PLANAR: tl.constexpr, NEEDS_INT64: tl.constexpr, BLOCK: tl.constexpr, PRECISION: tl.constexpr,
):  # fmt: skip
    """Compute y (count, OUT) from the `Rows` x (count, IN), as far as they are in use.

    W: `KernelWidths`. PLANAR: whether the stride between points of x is 1.
    """
    count = count_used_rows(used, count)
    b1, b2, b3 = biases
    w2 = packed + W.H1_P * W.IN_P
    w3 = w2 + W.H2_P * W.H1_P
    start = tl.program_id(0) * BLOCK
    while start < count:
        step = x.feature_stride
        if PLANAR:
            step += _opaque_zero(start, count)
        tile = round_factor(
            _load_tile(x.data, x.point_stride, step, start, count, W.IN, W.IN_P, BLOCK, NEEDS_INT64), PRECISION
        )
        tile = round_relu(linear(packed, b1, tile, W.H1, W.H1_P, W.IN_P, PRECISION), PRECISION)
        tile = round_relu(linear(w2, b2, tile, W.H2, W.H2_P, W.H1_P, PRECISION), PRECISION)
        tile = linear(w3, b3, tile, W.OUT, W.OUT_P, W.H2_P, PRECISION)
        _store_tile(tile, y, W.OUT, 1, start, count, W.OUT, W.OUT_P, BLOCK, False)
        start += tl.num_programs(0) * BLOCK


@triton.jit(do_not_specialize=["count"])
def backward_kernel(
    x, packed, biases, grad, grad_x, partials, count, used,
    W: tl.constexpr, UPPER_LAYERS: tl.constexpr, FIRST_LAYER: tl.constexpr, NEEDS_X: tl.constexpr,
    PLANAR: tl.constexpr, NEEDS_INT64: tl.constexpr, BLOCK: tl.constexpr, PRECISION: tl.constexpr,
):  # fmt: skip
    """Compute gradients of layers 2 and 3 (UPPER_LAYERS), of layer 1 (FIRST_LAYER), and of x (NEEDS_X).

    x, grad and grad_x are `Rows`. Each program writes its sums to its row of `partials` (programs, parameters): W1, W2,
    W3, b1, b2, b3, flattened.
    """
    count = count_used_rows(used, count)
    b1, b2 = biases
    w2 = packed + W.H1_P * W.IN_P
    w3 = w2 + W.H2_P * W.H1_P
    grad_w1 = tl.zeros([W.H1_P, W.IN_P], tl.float32)
    grad_w2 = tl.zeros([W.H2_P, W.H1_P], tl.float32)
    grad_w3 = tl.zeros([W.H2_P, W.OUT_P], tl.float32)
    grad_b1 = tl.zeros([W.H1_P], tl.float32)
    grad_b2 = tl.zeros([W.H2_P], tl.float32)
    grad_b3 = tl.zeros([W.OUT_P], tl.float32)
    start = tl.program_id(0) * BLOCK
    while start < count:
        step, grad_x_step = x.feature_stride, grad_x.feature_stride
        if PLANAR:
            step += _opaque_zero(start, count)
            grad_x_step += _opaque_zero(start, count)
        upstream = _load_tile(
            grad.data, grad.point_stride, grad.feature_stride, start, count, W.OUT, W.OUT_P, BLOCK, NEEDS_INT64
        )
        if tl.max(tl.max((upstream != 0).to(tl.int32), 1), 0) > 0:
            tile = round_factor(
                _load_tile(x.data, x.point_stride, step, start, count, W.IN, W.IN_P, BLOCK, NEEDS_INT64), PRECISION
            )
            hidden1 = round_relu(linear(packed, b1, tile, W.H1, W.H1_P, W.IN_P, PRECISION), PRECISION)
            hidden2 = round_relu(linear(w2, b2, hidden1, W.H2, W.H2_P, W.H1_P, PRECISION), PRECISION)
            grad3_factor = round_factor(upstream, PRECISION)
            if UPPER_LAYERS:
                grad_w3 = multiply_add(hidden2, tl.trans(grad3_factor), grad_w3, PRECISION)
                grad_b3 += tl.sum(upstream, 1)
            grad2 = multiply_add(
                load_tile_transposed(w3, W.OUT_P, W.H2_P),
                grad3_factor,
                tl.zeros([W.H2_P, BLOCK], tl.float32),
                PRECISION,
            )
            grad2 = tl.where(hidden2 > 0, grad2, 0.0)
            grad2_factor = round_factor(grad2, PRECISION)
            if UPPER_LAYERS:
                grad_w2 = multiply_add(grad2_factor, tl.trans(hidden1), grad_w2, PRECISION)
                grad_b2 += tl.sum(grad2, 1)
            if FIRST_LAYER or NEEDS_X:
                grad1 = multiply_add(
                    load_tile_transposed(w2, W.H2_P, W.H1_P),
                    grad2_factor,
                    tl.zeros([W.H1_P, BLOCK], tl.float32),
                    PRECISION,
                )
                grad1 = tl.where(hidden1 > 0, grad1, 0.0)
                grad1_factor = round_factor(grad1, PRECISION)
                if FIRST_LAYER:
                    grad_w1 = multiply_add(grad1_factor, tl.trans(tile), grad_w1, PRECISION)
                    grad_b1 += tl.sum(grad1, 1)
                if NEEDS_X:
                    grad_tile = multiply_add(
                        load_tile_transposed(packed, W.H1_P, W.IN_P),
                        grad1_factor,
                        tl.zeros([W.IN_P, BLOCK], tl.float32),
                        PRECISION,
                    )
                    _store_tile(
                        grad_tile,
                        grad_x.data,
                        grad_x.point_stride,
                        grad_x_step,
                        start,
                        count,
                        W.IN,
                        W.IN_P,
                        BLOCK,
                        NEEDS_INT64,
                    )
        elif NEEDS_X:
            zero_tile = tl.zeros([W.IN_P, BLOCK], tl.float32)
            _store_tile(
                zero_tile, grad_x.data, grad_x.point_stride, grad_x_step, start, count, W.IN, W.IN_P, BLOCK, NEEDS_INT64
            )
        start += tl.num_programs(0) * BLOCK
    partials += tl.program_id(0).to(tl.int64) * (W.H1 * W.IN + W.H2 * W.H1 + W.OUT * W.H2 + W.H1 + W.H2 + W.OUT)
    in_b1, in_b2, in_b3 = tl.arange(0, W.H1_P), tl.arange(0, W.H2_P), tl.arange(0, W.OUT_P)
    in_w1, in_w2 = tl.arange(0, W.IN_P)[None, :], tl.arange(0, W.H1_P)[None, :]
    if FIRST_LAYER:
        tl.store(partials + in_b1[:, None] * W.IN + in_w1, grad_w1, mask=(in_b1[:, None] < W.H1) & (in_w1 < W.IN))
    partials += W.H1 * W.IN
    if UPPER_LAYERS:
        tl.store(partials + in_b2[:, None] * W.H1 + in_w2, grad_w2, mask=(in_b2[:, None] < W.H2) & (in_w2 < W.H1))
        at = partials + W.H2 * W.H1
        inside = (in_b3[None, :] < W.OUT) & (in_b2[:, None] < W.H2)
        tl.store(at + in_b3[None, :] * W.H2 + in_b2[:, None], grad_w3, mask=inside)
    partials += W.H2 * W.H1 + W.OUT * W.H2
    if FIRST_LAYER:
        tl.store(partials + in_b1, grad_b1, mask=in_b1 < W.H1)
    if UPPER_LAYERS:
        tl.store(partials + W.H1 + in_b2, grad_b2, mask=in_b2 < W.H2)
        tl.store(partials + W.H1 + W.H2 + in_b3, grad_b3, mask=in_b3 < W.OUT)

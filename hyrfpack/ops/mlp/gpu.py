"""The multilayer perceptron on a GPU: two hidden layers in one kernel, on the matrix units.

Points are columns: a block of them is a tile [width, BLOCK], so features that are stored by rows load as they lie.
Programs are few and stay, each going through every so-many-th block. Hidden activations never leave the chip: backward
computes them again. A program adds up its own gradients of weights and biases and torch adds those of all programs: no
atomics, and the same bytes at every run on the same machine.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import torch
import triton
import triton.language as tl
from torch import Tensor

from hyrfpack.ops.dispatch import is_interpreting
from hyrfpack.ops.mlp.tiles import factor, linear, load_transposed, pack, precision, product, relu_factor, sizes

# Programs that stay on a processor at once, by the registers they take, and so all that are started.
_FORWARD_RESIDENT, _BACKWARD_RESIDENT = 4, 2
# Points a block. Forward: the most that leave registers for _FORWARD_RESIDENT programs; in float32, that do not spill.
_FORWARD_BLOCK, _FORWARD_BLOCK_SINGLE = 128, 32


def forward(x: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor], mixed: bool) -> tuple[Tensor, Tensor]:
    """(N, I) rows -> (N, O), and the packed weights, for `backward`."""
    constants = sizes([x.shape[1], *(weight.shape[0] for weight in weights)])
    way = precision(mixed)
    packed = pack(weights, way)
    result = x.new_empty(x.shape[0], constants["OUT"])
    block = _FORWARD_BLOCK if mixed else _FORWARD_BLOCK_SINGLE
    programs = _programs(x, block, _FORWARD_RESIDENT)
    if programs:
        forward_kernel[(programs,)](
            x,
            *x.stride(),
            packed,
            *(bias.contiguous() for bias in biases),
            result,
            x.shape[0],
            **constants,
            PLANAR=x.stride(0) == 1,
            LONG=_is_long(x),
            BLOCK=block,
            PRECISION=way,
            num_warps=_warps(constants),
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
) -> tuple[Tensor | None, list[Tensor], list[Tensor]]:
    """(N, O) gradient of the result -> gradients of x (None unless needed; stored as x is), weights and biases.

    Args:
        packed: from `forward`.
        biases: as in `forward`; the last is not needed.
        widths: of inputs, hidden layers and outputs.
    """
    constants = sizes(widths)
    way = precision(mixed)
    planar = x.stride(0) == 1
    grad_x = None
    if needs_x:
        grad_x = x.new_empty(x.shape[1], x.shape[0]).T if planar else torch.empty_like(x)
    inputs, hidden1, hidden2, outputs = widths
    lengths = [hidden1 * inputs, hidden2 * hidden1, outputs * hidden2, hidden1, hidden2, outputs]
    block = _backward_block(way, x.device)
    programs = _programs(x, block, _BACKWARD_RESIDENT)
    partials = x.new_empty(programs, sum(lengths))
    parts = [{"UPPER": True, "LOWER": True, "NEEDS_X": needs_x}]
    if way == "tf32x3":  # three times the factors: everything in one kernel would spill
        parts = [{name: name == part for name in parts[0]} for part, needed in parts[0].items() if needed]
    for part in parts if programs else []:
        backward_kernel[(programs,)](
            x,
            *x.stride(),
            packed,
            *(bias.contiguous() for bias in biases[:2]),
            grad,
            *grad.stride(),
            x if grad_x is None else grad_x,
            *(x if grad_x is None else grad_x).stride(),
            partials,
            x.shape[0],
            **constants,
            **part,
            PLANAR=planar,
            LONG=_is_long(x) or _is_long(grad),
            BLOCK=block,
            PRECISION=way,
            num_warps=_warps(constants),
            enable_fp_fusion=True,
        )
    w1, w2, w3, b1, b2, b3 = partials.sum(0).split(lengths)
    return (
        grad_x,
        [w1.view(hidden1, inputs), w2.view(hidden2, hidden1), w3.view(outputs, hidden2)],
        [b1, b2, b3],
    )


def _warps(constants: dict[str, int]) -> int:
    """Wide layers take the registers of twice as many threads."""
    return 8 if max(constants["IN_P"], constants["H1_P"], constants["H2_P"]) > 64 else 4


@cache
def _backward_block(precision: str, device: torch.device) -> int:
    """Points a block of the backward pass: the most that do not spill on this device.

    Matrix units that read a factor from shared memory (compute capability 9 and 10) leave registers for more.
    """
    if is_interpreting():
        return 32
    reads_shared = not torch.version.hip and torch.cuda.get_device_capability(device)[0] in (9, 10)
    return 32 if reads_shared and precision == "bf16" else 16


def _programs(x: Tensor, block: int, resident: int) -> int:
    """How many programs go through the rows of x."""
    return min(triton.cdiv(x.shape[0], block), resident * _processors(x.device))


@cache
def _processors(device: torch.device) -> int:
    return 1 if device.type == "cpu" else torch.cuda.get_device_properties(device).multi_processor_count


def _is_long(x: Tensor) -> bool:
    """Whether an offset from one feature to another may pass 32 bits."""
    return abs(x.stride(1)) * x.shape[1] >= 2**31


@triton.jit
def _offsets(stride_point, stride_feature, HEIGHT: tl.constexpr, BLOCK: tl.constexpr, LONG: tl.constexpr):
    feature, point = tl.arange(0, HEIGHT)[:, None], tl.arange(0, BLOCK)[None, :]
    if LONG:
        feature = feature.to(tl.int64)
    return feature * stride_feature + point * stride_point


@triton.jit
def _inside(start, count, WIDTH: tl.constexpr, HEIGHT: tl.constexpr, BLOCK: tl.constexpr):
    return (tl.arange(0, HEIGHT)[:, None] < WIDTH) & (tl.arange(0, BLOCK)[None, :] < count - start)


@triton.jit
def _load(
    x, stride_point, stride_feature, start, count,
    WIDTH: tl.constexpr, HEIGHT: tl.constexpr, BLOCK: tl.constexpr, LONG: tl.constexpr,
):  # fmt: skip
    """Rows start, start + 1, ... of x (count, WIDTH) as a tile [HEIGHT, BLOCK], zero outside."""
    x += start.to(tl.int64) * stride_point
    offsets = _offsets(stride_point, stride_feature, HEIGHT, BLOCK, LONG)
    return tl.load(x + offsets, mask=_inside(start, count, WIDTH, HEIGHT, BLOCK), other=0.0)


@triton.jit
def _store(
    tile, x, stride_point, stride_feature, start, count,
    WIDTH: tl.constexpr, HEIGHT: tl.constexpr, BLOCK: tl.constexpr, LONG: tl.constexpr,
):  # fmt: skip
    """The inverse of `_load`."""
    x += start.to(tl.int64) * stride_point
    offsets = _offsets(stride_point, stride_feature, HEIGHT, BLOCK, LONG)
    tl.store(x + offsets, tile, mask=_inside(start, count, WIDTH, HEIGHT, BLOCK))


@triton.jit
def _zero(start, count):
    """Zero in every block that there is, which the compiler cannot know.

    Added to a stride it keeps the addresses of a tile from being computed before the loop, once for all blocks: they
    would hold 64 bits of registers for every number of the tile that a thread loads.
    """
    return tl.minimum(count - start - 1, 0)


@triton.jit(do_not_specialize=["count"])
def forward_kernel(
    x, stride_point, stride_feature, packed, b1, b2, b3, y, count,
    IN: tl.constexpr, H1: tl.constexpr, H2: tl.constexpr, OUT: tl.constexpr,
    IN_P: tl.constexpr, H1_P: tl.constexpr, H2_P: tl.constexpr, OUT_P: tl.constexpr,
    PLANAR: tl.constexpr, LONG: tl.constexpr, BLOCK: tl.constexpr, PRECISION: tl.constexpr,
):  # fmt: skip
    """y (count, OUT) of x (count, IN); PLANAR: x's stride of points is 1."""
    w2 = packed + H1_P * IN_P
    w3 = w2 + H2_P * H1_P
    start = tl.program_id(0) * BLOCK
    while start < count:
        step = stride_feature
        if PLANAR:
            step += _zero(start, count)
        tile = factor(_load(x, stride_point, step, start, count, IN, IN_P, BLOCK, LONG), PRECISION)
        tile = relu_factor(linear(packed, b1, tile, H1, H1_P, IN_P, PRECISION), PRECISION)
        tile = relu_factor(linear(w2, b2, tile, H2, H2_P, H1_P, PRECISION), PRECISION)
        tile = linear(w3, b3, tile, OUT, OUT_P, H2_P, PRECISION)
        _store(tile, y, OUT, 1, start, count, OUT, OUT_P, BLOCK, False)
        start += tl.num_programs(0) * BLOCK


@triton.jit(do_not_specialize=["count"])
def backward_kernel(
    x, stride_point, stride_feature, packed, b1, b2, grad, grad_stride_point, grad_stride_output,
    grad_x, grad_x_stride_point, grad_x_stride_feature, partials, count,
    IN: tl.constexpr, H1: tl.constexpr, H2: tl.constexpr, OUT: tl.constexpr,
    IN_P: tl.constexpr, H1_P: tl.constexpr, H2_P: tl.constexpr, OUT_P: tl.constexpr,
    UPPER: tl.constexpr, LOWER: tl.constexpr, NEEDS_X: tl.constexpr,
    PLANAR: tl.constexpr, LONG: tl.constexpr, BLOCK: tl.constexpr, PRECISION: tl.constexpr,
):  # fmt: skip
    """Gradients of the second and third layer (UPPER), of the first (LOWER), and of x (NEEDS_X).

    partials: (programs, parameters), W1, W2, W3, b1, b2, b3 in a row.
    """
    w2 = packed + H1_P * IN_P
    w3 = w2 + H2_P * H1_P
    grad_w1 = tl.zeros([H1_P, IN_P], tl.float32)
    grad_w2 = tl.zeros([H2_P, H1_P], tl.float32)
    grad_w3 = tl.zeros([H2_P, OUT_P], tl.float32)
    grad_b1 = tl.zeros([H1_P], tl.float32)
    grad_b2 = tl.zeros([H2_P], tl.float32)
    grad_b3 = tl.zeros([OUT_P], tl.float32)
    start = tl.program_id(0) * BLOCK
    while start < count:
        step, grad_x_step = stride_feature, grad_x_stride_feature
        if PLANAR:
            step += _zero(start, count)
            grad_x_step += _zero(start, count)
        upstream = _load(grad, grad_stride_point, grad_stride_output, start, count, OUT, OUT_P, BLOCK, LONG)
        if tl.max(tl.max((upstream != 0).to(tl.int32), 1), 0) > 0:
            tile = factor(_load(x, stride_point, step, start, count, IN, IN_P, BLOCK, LONG), PRECISION)
            hidden1 = relu_factor(linear(packed, b1, tile, H1, H1_P, IN_P, PRECISION), PRECISION)
            hidden2 = relu_factor(linear(w2, b2, hidden1, H2, H2_P, H1_P, PRECISION), PRECISION)
            down3 = factor(upstream, PRECISION)
            if UPPER:
                grad_w3 = product(hidden2, tl.trans(down3), grad_w3, PRECISION)
                grad_b3 += tl.sum(upstream, 1)
            exact = product(load_transposed(w3, OUT_P, H2_P), down3, tl.zeros([H2_P, BLOCK], tl.float32), PRECISION)
            exact = tl.where(hidden2 > 0, exact, 0.0)
            down2 = factor(exact, PRECISION)
            if UPPER:
                grad_w2 = product(down2, tl.trans(hidden1), grad_w2, PRECISION)
                grad_b2 += tl.sum(exact, 1)
            if LOWER or NEEDS_X:
                exact1 = product(load_transposed(w2, H2_P, H1_P), down2, tl.zeros([H1_P, BLOCK], tl.float32), PRECISION)
                exact1 = tl.where(hidden1 > 0, exact1, 0.0)
                down1 = factor(exact1, PRECISION)
                if LOWER:
                    grad_w1 = product(down1, tl.trans(tile), grad_w1, PRECISION)
                    grad_b1 += tl.sum(exact1, 1)
                if NEEDS_X:
                    below = product(
                        load_transposed(packed, H1_P, IN_P), down1, tl.zeros([IN_P, BLOCK], tl.float32), PRECISION
                    )
                    _store(below, grad_x, grad_x_stride_point, grad_x_step, start, count, IN, IN_P, BLOCK, LONG)
        elif NEEDS_X:
            idle = tl.zeros([IN_P, BLOCK], tl.float32)
            _store(idle, grad_x, grad_x_stride_point, grad_x_step, start, count, IN, IN_P, BLOCK, LONG)
        start += tl.num_programs(0) * BLOCK
    partials += tl.program_id(0).to(tl.int64) * (H1 * IN + H2 * H1 + OUT * H2 + H1 + H2 + OUT)
    in_b1, in_b2, in_b3 = tl.arange(0, H1_P), tl.arange(0, H2_P), tl.arange(0, OUT_P)
    in_w1, in_w2 = tl.arange(0, IN_P)[None, :], tl.arange(0, H1_P)[None, :]
    if LOWER:
        tl.store(partials + in_b1[:, None] * IN + in_w1, grad_w1, mask=(in_b1[:, None] < H1) & (in_w1 < IN))
    partials += H1 * IN
    if UPPER:
        tl.store(partials + in_b2[:, None] * H1 + in_w2, grad_w2, mask=(in_b2[:, None] < H2) & (in_w2 < H1))
        at = partials + H2 * H1
        inside = (in_b3[None, :] < OUT) & (in_b2[:, None] < H2)
        tl.store(at + in_b3[None, :] * H2 + in_b2[:, None], grad_w3, mask=inside)
    partials += H2 * H1 + OUT * H2
    if LOWER:
        tl.store(partials + in_b1, grad_b1, mask=in_b1 < H1)
    if UPPER:
        tl.store(partials + H1 + in_b2, grad_b2, mask=in_b2 < H2)
        tl.store(partials + H1 + H2 + in_b3, grad_b3, mask=in_b3 < OUT)

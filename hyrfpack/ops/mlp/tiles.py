"""What kernels that run perceptrons of two hidden layers share: products on the matrix units, and packed weights.

A tile holds one column a point. Its height is a power of two of at least 16, the least the matrix units take; rows
past the true height are zero. Kernels are built for widths IN -> H1 -> H2 -> OUT and for the tiles' IN_P, H1_P, ...
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import triton
import triton.language as tl
from torch import Tensor

from hyrfpack.ops.dispatch import is_interpreting


def sizes(widths: Sequence[int]) -> dict[str, int]:
    """Widths (inputs, hidden, hidden, outputs) as the constants kernels are built for, those of tiles with them."""
    names = ("IN", "H1", "H2", "OUT")
    padded = {f"{name}_P": max(16, triton.next_power_of_2(width)) for name, width in zip(names, widths, strict=True)}
    return dict(zip(names, widths, strict=True)) | padded


def precision(mixed: bool) -> str:
    """How `product` multiplies here: "bf16" when mixed, else what keeps float32's accuracy on this machine.

    NVIDIA's matrix units reach it in three passes of shortened factors, several times as fast as plain arithmetic;
    AMD's take float32 as it is. The interpreter multiplies bfloat16 wrongly and cuts what it should round: there,
    float32 is rounded by its bits.
    """
    if mixed:
        return "rounded" if is_interpreting() else "bf16"
    return "ieee" if torch.version.hip else "tf32x3"


def pack(weights: Sequence[Tensor], precision: str) -> Tensor:
    """Three weight matrices (out, in), one after the other, padded and rounded, as `load_tile` takes them.

    Kernels read them anew for every block of points, which must be quick and take few registers.
    """
    constants = sizes([weights[0].shape[1], *(weight.shape[0] for weight in weights)])
    shapes = ("H1_P", "IN_P"), ("H2_P", "H1_P"), ("OUT_P", "H2_P")
    total = sum(constants[height] * constants[width] for height, width in shapes)
    packed = weights[0].new_empty(total, dtype=torch.bfloat16 if precision == "bf16" else torch.float32)
    _pack[(3,)](
        *(weight.contiguous() for weight in weights),
        packed,
        **constants,
        PRECISION=precision,
        num_warps=4,
        enable_fp_fusion=True,
    )
    return packed


@triton.jit
def factor(tile, PRECISION: tl.constexpr):
    """A tile as `product` takes it: rounded to the nearest, ties to even, where factors are rounded."""
    if PRECISION == "bf16":
        tile = tile.to(tl.bfloat16)
    elif PRECISION == "rounded":
        bits = tile.to(tl.uint32, bitcast=True)
        bits = (bits + 0x7FFF + ((bits >> 16) & 1)) & 0xFFFF0000
        tile = bits.to(tl.float32, bitcast=True)
    return tile


@triton.jit
def product(a, b, total, PRECISION: tl.constexpr):
    """total + a b in float32, of two results of `factor`."""
    if PRECISION == "bf16":
        total = tl.dot(a, b, total)
    elif PRECISION == "rounded":
        total = tl.dot(a, b, total, input_precision="ieee")
    else:
        total = tl.dot(a, b, total, input_precision=PRECISION)
    return total


@triton.jit
def linear(weight, bias, x, ROWS: tl.constexpr, HEIGHT: tl.constexpr, WIDTH: tl.constexpr, PRECISION: tl.constexpr):
    """W x + b of a tile [WIDTH, BLOCK] that is a factor: [HEIGHT, BLOCK]."""
    total = tl.broadcast_to(load_vector(bias, ROWS, HEIGHT)[:, None], [HEIGHT, x.shape[1]])
    return product(load_tile(weight, HEIGHT, WIDTH), x, total, PRECISION)


@triton.jit
def relu_factor(x, PRECISION: tl.constexpr):
    """`factor` of relu(x); a NaN stays one."""
    return factor(tl.where(x < 0, 0.0, x), PRECISION)


@triton.jit
def load_tile(source, HEIGHT: tl.constexpr, WIDTH: tl.constexpr):
    """A packed matrix [HEIGHT, WIDTH]."""
    return tl.load(source + tl.arange(0, HEIGHT)[:, None] * WIDTH + tl.arange(0, WIDTH)[None, :])


@triton.jit
def load_transposed(source, HEIGHT: tl.constexpr, WIDTH: tl.constexpr):
    """The transpose [WIDTH, HEIGHT] of a packed matrix."""
    return tl.load(source + tl.arange(0, HEIGHT)[None, :] * WIDTH + tl.arange(0, WIDTH)[:, None])


@triton.jit
def load_vector(source, LENGTH: tl.constexpr, HEIGHT: tl.constexpr):
    """A vector [HEIGHT], zero past its length."""
    row = tl.arange(0, HEIGHT)
    return tl.load(source + row, mask=row < LENGTH, other=0.0)


@triton.jit
def _pack_matrix(
    source, target,
    ROWS: tl.constexpr, COLUMNS: tl.constexpr, HEIGHT: tl.constexpr, WIDTH: tl.constexpr, PRECISION: tl.constexpr,
):  # fmt: skip
    row, column = tl.arange(0, HEIGHT)[:, None], tl.arange(0, WIDTH)[None, :]
    matrix = tl.load(source + row * COLUMNS + column, mask=(row < ROWS) & (column < COLUMNS), other=0.0)
    tl.store(target + row * WIDTH + column, factor(matrix, PRECISION))


@triton.jit
def _pack(
    w1, w2, w3, packed,
    IN: tl.constexpr, H1: tl.constexpr, H2: tl.constexpr, OUT: tl.constexpr,
    IN_P: tl.constexpr, H1_P: tl.constexpr, H2_P: tl.constexpr, OUT_P: tl.constexpr,
    PRECISION: tl.constexpr,
):  # fmt: skip
    layer = tl.program_id(0)
    if layer == 0:
        _pack_matrix(w1, packed, H1, IN, H1_P, IN_P, PRECISION)
    elif layer == 1:
        _pack_matrix(w2, packed + H1_P * IN_P, H2, H1, H2_P, H1_P, PRECISION)
    else:
        _pack_matrix(w3, packed + H1_P * IN_P + H2_P * H1_P, OUT, H2, OUT_P, H2_P, PRECISION)

"""Provides matrix products and packed weights for all kernels that evaluate perceptrons of two hidden layers.

A tile holds one column per point. Its height is a power of two of at least 16, the minimum of the matrix units; padding
rows are zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import torch
import triton
import triton.language as tl
from torch import Tensor

from hyrfpack.ops.dispatch import is_interpreting


class KernelWidths(NamedTuple):
    """The widths of a perceptron's layers, for which kernels are compiled.

    Attributes:
        IN, H1, H2, OUT: numbers of inputs, neurons of both hidden layers, and outputs.
        IN_P, H1_P, H2_P, OUT_P: heights of the tiles that hold them, see `pad_width`.
    """

    IN: tl.constexpr
    H1: tl.constexpr
    H2: tl.constexpr
    OUT: tl.constexpr
    IN_P: tl.constexpr
    H1_P: tl.constexpr
    H2_P: tl.constexpr
    OUT_P: tl.constexpr


def pad_width(width: int) -> int:
    """Return the height of a tile that holds this many numbers per point."""
    return max(16, triton.next_power_of_2(width))


def kernel_widths(widths: Sequence[int]) -> KernelWidths:
    """Return the compile-time constant of kernels for these widths (inputs, hidden, hidden, outputs)."""
    return KernelWidths(*map(tl.constexpr, (*widths, *map(pad_width, widths))))


def product_precision(mixed: bool) -> str:
    """Return the precision with which `multiply_add` multiplies on this machine.

    This is "bf16" if mixed, else the fastest method with the accuracy of float32. On NVIDIA's matrix units that is
    "tf32x3": three passes with shortened factors, several times as fast as plain arithmetic. AMD's matrix units
    multiply float32 ("ieee"). Triton's interpreter multiplies bfloat16 incorrectly and truncates instead of rounding;
    "rounded" rounds the bits of float32 there.
    """
    if mixed:
        return "rounded" if is_interpreting() else "bf16"
    return "ieee" if torch.version.hip else "tf32x3"


def pack_weights(weights: Sequence[Tensor], precision: str) -> Tensor:
    """Pack three weight matrices (out, in) into one tensor, padded and rounded, for `load_tile`.

    Kernels reload the weights for every block of points, so these loads must be fast and use few registers.
    """
    widths = [weights[0].shape[1], *(weight.shape[0] for weight in weights)]
    total = sum(pad_width(height) * pad_width(width) for width, height in pairwise(widths))
    packed = weights[0].new_empty(total, dtype=torch.bfloat16 if precision == "bf16" else torch.float32)
    _pack_kernel[(3,)](
        *(weight.contiguous() for weight in weights),
        packed,
        W=kernel_widths(widths),
        PRECISION=precision,
        num_warps=4,
        enable_fp_fusion=True,
    )
    return packed


@triton.jit
def round_factor(tile, PRECISION: tl.constexpr):
    """Round a tile to the factor precision of `multiply_add`, to the nearest with ties to even."""
    if PRECISION == "bf16":
        tile = tile.to(tl.bfloat16)
    elif PRECISION == "rounded":
        bits = tile.to(tl.uint32, bitcast=True)
        bits = (bits + 0x7FFF + ((bits >> 16) & 1)) & 0xFFFF0000
        tile = bits.to(tl.float32, bitcast=True)
    return tile


@triton.jit
def multiply_add(a, b, total, PRECISION: tl.constexpr):
    """Return total + a b in float32, where a and b are results of `round_factor`."""
    if PRECISION == "bf16":
        total = tl.dot(a, b, total)
    elif PRECISION == "rounded":
        total = tl.dot(a, b, total, input_precision="ieee")
    else:
        total = tl.dot(a, b, total, input_precision=PRECISION)
    return total


@triton.jit
def linear(weight, bias, x, ROWS: tl.constexpr, HEIGHT: tl.constexpr, WIDTH: tl.constexpr, PRECISION: tl.constexpr):
    """Return W x + b, [HEIGHT, BLOCK], of a tile x [WIDTH, BLOCK] that is a result of `round_factor`."""
    total = tl.broadcast_to(load_padded_vector(bias, ROWS, HEIGHT)[:, None], [HEIGHT, x.shape[1]])
    return multiply_add(load_tile(weight, HEIGHT, WIDTH), x, total, PRECISION)


@triton.jit
def round_relu(x, PRECISION: tl.constexpr):
    """Return `round_factor` of relu(x); NaN stays NaN."""
    return round_factor(tl.where(x < 0, 0.0, x), PRECISION)


@triton.jit
def load_tile(source, HEIGHT: tl.constexpr, WIDTH: tl.constexpr):
    """Load a packed matrix [HEIGHT, WIDTH]."""
    return tl.load(source + tl.arange(0, HEIGHT)[:, None] * WIDTH + tl.arange(0, WIDTH)[None, :])


@triton.jit
def load_tile_transposed(source, HEIGHT: tl.constexpr, WIDTH: tl.constexpr):
    """Load the transpose [WIDTH, HEIGHT] of a packed matrix."""
    return tl.load(source + tl.arange(0, HEIGHT)[None, :] * WIDTH + tl.arange(0, WIDTH)[:, None])


@triton.jit
def load_padded_vector(source, LENGTH: tl.constexpr, HEIGHT: tl.constexpr):
    """Load a vector, padded with zeros to [HEIGHT]."""
    row = tl.arange(0, HEIGHT)
    return tl.load(source + row, mask=row < LENGTH, other=0.0)


@triton.jit
def _pack_matrix(
    source, target,
    ROWS: tl.constexpr, COLUMNS: tl.constexpr, HEIGHT: tl.constexpr, WIDTH: tl.constexpr, PRECISION: tl.constexpr,
):  # fmt: skip
    """Write a matrix (ROWS, COLUMNS), padded to [HEIGHT, WIDTH] and rounded."""
    row, column = tl.arange(0, HEIGHT)[:, None], tl.arange(0, WIDTH)[None, :]
    matrix = tl.load(source + row * COLUMNS + column, mask=(row < ROWS) & (column < COLUMNS), other=0.0)
    tl.store(target + row * WIDTH + column, round_factor(matrix, PRECISION))


@triton.jit
def _pack_kernel(w1, w2, w3, packed, W: tl.constexpr, PRECISION: tl.constexpr):
    """Write one weight matrix per program, see `pack_weights`."""
    layer = tl.program_id(0)
    if layer == 0:
        _pack_matrix(w1, packed, W.H1, W.IN, W.H1_P, W.IN_P, PRECISION)
    elif layer == 1:
        _pack_matrix(w2, packed + W.H1_P * W.IN_P, W.H2, W.H1, W.H2_P, W.H1_P, PRECISION)
    else:
        _pack_matrix(w3, packed + W.H1_P * W.IN_P + W.H2_P * W.H1_P, W.OUT, W.H2, W.OUT_P, W.H2_P, PRECISION)

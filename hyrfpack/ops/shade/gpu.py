"""Shades Gaussians in Triton. A block of Gaussians is a tile [width, BLOCK]; the decoder runs on the matrix units.

`shade_block` is a separate function, so that the kernel that projects Gaussians can also shade those it draws.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
import triton
import triton.language as tl
from torch import Tensor

from hyrfpack.ops.mlp.tiles import (
    kernel_widths,
    linear,
    multiply_add,
    pack_weights,
    product_precision,
    round_factor,
    round_relu,
)
from hyrfpack.ops.shade.gpu_directions import encode_block, normalize_block

if TYPE_CHECKING:
    from hyrfpack.ops.shade import Shading


def launch_size(mixed: bool) -> tuple[int, int]:
    """Return the Gaussians and the warps per program: as many as registers allow; float32 factors need more."""
    return (128, 4) if mixed else (64, 8)


@triton.jit
def shade_block(
    mean, index, live, viewpoint, first_layer, packed, b2, b3, color_logits,
    IN: tl.constexpr, H1: tl.constexpr, H2: tl.constexpr, OUT: tl.constexpr,
    IN_P: tl.constexpr, H1_P: tl.constexpr, H2_P: tl.constexpr, OUT_P: tl.constexpr,
    FREQUENCY: tl.constexpr, PRECISION: tl.constexpr,
):  # fmt: skip
    """Compute the colours, a tuple of 3 blocks, of Gaussians `index` where live; undefined elsewhere.

    Args:
        mean: tuple of 3 blocks.
        viewpoint: tuple of 3 numbers.
        first_layer, color_logits: pointers to (N, H1) and (N, 3).
        packed: the result of `tiles.pack_weights`, the direction's weight first.
        b2, b3: biases of the second and third layer.
    """
    x, y, z = normalize_block(mean[0] - viewpoint[0], mean[1] - viewpoint[1], mean[2] - viewpoint[2])
    neuron = tl.arange(0, H1_P)[:, None]
    at = first_layer + index[None, :].to(tl.int64) * H1 + neuron
    hidden = tl.load(at, mask=live[None, :] & (neuron < H1), other=0.0).to(tl.float32)
    # Slices of 16 rows, the minimum of the matrix units, take fewer registers than a whole tile.
    for row in tl.static_range(0, IN_P, 16):
        weight = tl.load(packed + neuron * IN_P + (row + tl.arange(0, 16)[None, :]))
        encoded = round_factor(encode_block(x, y, z, FREQUENCY, row, 16), PRECISION)
        hidden = multiply_add(weight, encoded, hidden, PRECISION)
    hidden = round_relu(hidden, PRECISION)
    w2 = packed + H1_P * IN_P
    hidden = round_relu(linear(w2, b2, hidden, H2, H2_P, H1_P, PRECISION), PRECISION)
    raw = linear(w2 + H2_P * H1_P, b3, hidden, OUT, OUT_P, H2_P, PRECISION)
    channel = tl.arange(0, OUT_P)[:, None]
    logits = color_logits + index.to(tl.int64) * 3
    red = tl.sum(tl.where(channel == 0, raw, 0.0), 0) + tl.load(logits, mask=live, other=0.0)
    green = tl.sum(tl.where(channel == 1, raw, 0.0), 0) + tl.load(logits + 1, mask=live, other=0.0)
    blue = tl.sum(tl.where(channel == 2, raw, 0.0), 0) + tl.load(logits + 2, mask=live, other=0.0)
    return tl.sigmoid(red), tl.sigmoid(green), tl.sigmoid(blue)


@triton.jit(do_not_specialize=["total"])
def shade_kernel(
    means, viewpoint, first_layer, packed, b2, b3, color_logits, colors, total,
    IN: tl.constexpr, H1: tl.constexpr, H2: tl.constexpr, OUT: tl.constexpr,
    IN_P: tl.constexpr, H1_P: tl.constexpr, H2_P: tl.constexpr, OUT_P: tl.constexpr,
    FREQUENCY: tl.constexpr, PRECISION: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Write the colours (N, 3) of a block of Gaussians."""
    index = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = index < total
    row = index.to(tl.int64) * 3
    mean = (
        tl.load(means + row, mask=live, other=0.0),
        tl.load(means + row + 1, mask=live, other=0.0),
        tl.load(means + row + 2, mask=live, other=0.0),
    )
    origin = tl.load(viewpoint), tl.load(viewpoint + 1), tl.load(viewpoint + 2)
    red, green, blue = shade_block(
        mean, index, live, origin, first_layer, packed, b2, b3, color_logits,
        IN, H1, H2, OUT, IN_P, H1_P, H2_P, OUT_P, FREQUENCY, PRECISION,
    )  # fmt: skip
    tl.store(colors + row, red, mask=live)
    tl.store(colors + row + 1, green, mask=live)
    tl.store(colors + row + 2, blue, mask=live)


def kernel_arguments(shading: Shading) -> tuple[tuple[Tensor, ...], dict]:
    """Return the tensors that `shade_block` takes after the viewpoint, and its constants by name."""
    precision = product_precision(shading.mixed)
    weights = (shading.direction_weight, *shading.weights)
    later = (tensor.detach().contiguous() for tensor in (*shading.biases, shading.color_logits))
    tensors = shading.first_layer.contiguous(), pack_weights(weights, precision), *later
    widths = [shading.direction_weight.shape[1], *(weight.shape[0] for weight in weights)]
    constants = kernel_widths(widths) | {"FREQUENCY": shading.encoding == "frequency", "PRECISION": precision}
    return tensors, constants


def shade(positions: Tensor, viewpoint: Tensor, shading: Shading) -> Tensor:
    """Compute the colours of `hyrfpack.ops.shade.shade`."""
    tensors, constants = shading.kernel_arguments
    colors = torch.empty_like(positions, memory_format=torch.contiguous_format)
    if len(positions):
        block, warps = launch_size(shading.mixed)
        shade_kernel[(triton.cdiv(len(positions), block),)](
            positions.detach().contiguous(), viewpoint.detach().contiguous(), *tensors, colors, len(positions),
            **constants, BLOCK=block, num_warps=warps, enable_fp_fusion=True,
        )  # fmt: skip
    return colors

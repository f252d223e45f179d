"""Shades Gaussians in Triton. A block of Gaussians is a tile [width, BLOCK]; the decoder runs on the matrix units.

`shade_block` is a separate function, so that the kernel that projects Gaussians can also shade those it draws.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

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


class DecoderTensors(NamedTuple):
    """The tensors of a `Shading` as an argument of kernels.

    Attributes:
        first_layer, color_logits: (N, H1) and (N, 3).
        packed: the result of `tiles.pack_weights`, the direction's weight first.
        b2, b3: biases of the second and third layer.
    """

    first_layer: Tensor
    packed: Tensor
    b2: Tensor
    b3: Tensor
    color_logits: Tensor


def launch_size(mixed: bool) -> tuple[int, int]:
    """Return the Gaussians and the warps per program: as many as registers allow; float32 factors need more."""
    return (128, 4) if mixed else (64, 8)


@triton.jit
def shade_block(
    mean, index, live, viewpoint, decoder, W: tl.constexpr, FREQUENCY: tl.constexpr, PRECISION: tl.constexpr
):
    """Compute the colours, a tuple of 3 blocks, of Gaussians `index` where live; undefined elsewhere.

    Args:
        mean: tuple of 3 blocks.
        viewpoint: tuple of 3 numbers.
        decoder: `DecoderTensors`.
        W: `tiles.KernelWidths`.
    """
    x, y, z = normalize_block(mean[0] - viewpoint[0], mean[1] - viewpoint[1], mean[2] - viewpoint[2])
    neuron = tl.arange(0, W.H1_P)[:, None]
    at = decoder.first_layer + index[None, :].to(tl.int64) * W.H1 + neuron
    hidden = tl.load(at, mask=live[None, :] & (neuron < W.H1), other=0.0).to(tl.float32)
    # Slices of 16 rows, the minimum of the matrix units, take fewer registers than a whole tile.
    for row in tl.static_range(0, W.IN_P, 16):
        weight = tl.load(decoder.packed + neuron * W.IN_P + (row + tl.arange(0, 16)[None, :]))
        encoded = round_factor(encode_block(x, y, z, FREQUENCY, row, 16), PRECISION)
        hidden = multiply_add(weight, encoded, hidden, PRECISION)
    hidden = round_relu(hidden, PRECISION)
    w2 = decoder.packed + W.H1_P * W.IN_P
    hidden = round_relu(linear(w2, decoder.b2, hidden, W.H2, W.H2_P, W.H1_P, PRECISION), PRECISION)
    raw = linear(w2 + W.H2_P * W.H1_P, decoder.b3, hidden, W.OUT, W.OUT_P, W.H2_P, PRECISION)
    channel = tl.arange(0, W.OUT_P)[:, None]
    logits = decoder.color_logits + index.to(tl.int64) * 3
    red = tl.sum(tl.where(channel == 0, raw, 0.0), 0) + tl.load(logits, mask=live, other=0.0)
    green = tl.sum(tl.where(channel == 1, raw, 0.0), 0) + tl.load(logits + 1, mask=live, other=0.0)
    blue = tl.sum(tl.where(channel == 2, raw, 0.0), 0) + tl.load(logits + 2, mask=live, other=0.0)
    return tl.sigmoid(red), tl.sigmoid(green), tl.sigmoid(blue)


@triton.jit(do_not_specialize=["total"])
def shade_kernel(
    means, viewpoint, decoder, colors, total,
    W: tl.constexpr, FREQUENCY: tl.constexpr, PRECISION: tl.constexpr, BLOCK: tl.constexpr,
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
    red, green, blue = shade_block(mean, index, live, origin, decoder, W, FREQUENCY, PRECISION)
    tl.store(colors + row, red, mask=live)
    tl.store(colors + row + 1, green, mask=live)
    tl.store(colors + row + 2, blue, mask=live)


def kernel_arguments(shading: Shading) -> tuple[DecoderTensors, dict[str, Any]]:
    """Return the decoder that `shade_block` takes, and its constants by name."""
    precision = product_precision(shading.mixed)
    weights = (shading.direction_weight, *shading.weights)
    later = (tensor.detach().contiguous() for tensor in (*shading.biases, shading.color_logits))
    decoder = DecoderTensors(shading.first_layer.contiguous(), pack_weights(weights, precision), *later)
    widths = [shading.direction_weight.shape[1], *(weight.shape[0] for weight in weights)]
    frequency = shading.encoding == "frequency"
    return decoder, {"W": kernel_widths(widths), "FREQUENCY": frequency, "PRECISION": precision}


def shade(positions: Tensor, viewpoint: Tensor, shading: Shading) -> Tensor:
    """Compute the colours of `hyrfpack.ops.shade.shade`."""
    decoder, constants = shading.kernel_arguments
    colors = torch.empty_like(positions, memory_format=torch.contiguous_format)
    if len(positions):
        block, warps = launch_size(shading.mixed)
        shade_kernel[(triton.cdiv(len(positions), block),)](
            positions.detach().contiguous(), viewpoint.detach().contiguous(), decoder, colors, len(positions),
            **constants, BLOCK=block, num_warps=warps, enable_fp_fusion=True,
        )  # fmt: skip
    return colors

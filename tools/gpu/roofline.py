"""Count the least work of each operation from the sizes of a call: bytes moved through memory, and arithmetic.

Bytes: every input is read once and every output is written once, in float32 unless stated otherwise. If an
implementation reads data again or stores data between its kernels, its share of the roofline is lower. Operations:
one for each addition, multiplication, comparison and special function, two for a multiply-add.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from tools.gpu.timing import Rates

TILE_PIXELS = 16 * 16
RADIX_BITS_PER_PASS = 8
SSIM_WINDOW_TAPS = 11


@dataclass(frozen=True)
class Work:
    """Bytes and operations of one call.

    Attributes:
        bytes: bytes read and written.
        flops: floating point operations.
        unit: the attribute of `Rates` that limits the arithmetic, "fp32" or "bf16".
    """

    bytes: float
    flops: float
    unit: str = "fp32"

    def __add__(self, other: Work) -> Work:
        return Work(self.bytes + other.bytes, self.flops + other.flops, self.unit)

    def shares(self, ms: float, rates: Rates) -> tuple[float, float]:
        """Return the fractions of the measured copy rate and arithmetic rate that a call of `ms` reaches."""
        seconds = 1e-3 * ms
        return self.bytes / seconds / rates.copy, self.flops / seconds / getattr(rates, self.unit)

    def min_ms(self, rates: Rates) -> float:
        """Return the roofline time in ms, the lower bound of any call."""
        return 1e3 * max(self.bytes / rates.copy, self.flops / getattr(rates, self.unit))


def count_project(gaussians: int) -> Work:
    """Count the work of the projection.

    It reads mean 3, quaternion 4, scale 3, opacity 1 and writes mean2d 2, conic 3, depth 1, opacity 1 (44 + 28 bytes).
    The operations are: to the camera 18, rotation matrix 30, J R Q S 45, covariance 18, determinant and inverse 20,
    the rest 15; in total 146.
    """
    return Work(72 * gaussians, 146 * gaussians)


def count_project_backward(gaussians: int) -> Work:
    """Count the work of the projection's backward pass.

    It reads the same 11 numbers and the gradients of mean2d 2, conic 3 and opacity 1, and writes 11. The arithmetic is
    twice that of the forward pass.
    """
    return Work(112 * gaussians, 292 * gaussians)


def count_sort_bytes(items: int, key_bits: int) -> int:
    """Count the bytes of a radix sort of 4-byte keys with 4-byte values: each pass reads and writes both once."""
    return 16 * items * -(-key_bits // RADIX_BITS_PER_PASS)


def count_bin_pairs(gaussians: int, pairs: int, tiles: int) -> Work:
    """Count the work of binning.

    It sorts Gaussians by depth (32 bits), writes a tile and an index for each pair, and sorts the pairs by tile. It
    reads 7 numbers per Gaussian. The arithmetic is negligible: 20 operations per Gaussian and 10 per pair.
    """
    sorting = count_sort_bytes(gaussians, 32) + count_sort_bytes(pairs, max(1, (tiles - 1).bit_length()))
    return Work(28 * gaussians + 8 * pairs + sorting, 20 * gaussians + 10 * pairs)


def count_blend(pairs: int, pixels: int, reached: float, blended: float) -> Work:
    """Count the work of blending.

    It reads index 1, mean2d 2, conic 3, opacity 1 and colour 3 of each reached pair (40 bytes), and writes rgb and T
    (16 bytes per pixel). A reached pair costs 12 operations at each of 256 pixels (offset 2, exponent 8, exp 1, opacity
    1), and a blended one 10 more (threshold, clamp, weight, three multiply-adds, T).

    Args:
        pairs: number of Gaussian-tile pairs.
        pixels: number of pixels.
        reached: mean share of a tile's pairs that are processed before all its pixels are finished.
        blended: mean number of Gaussians that contribute to a pixel.
    """
    evaluations = reached * pairs * TILE_PIXELS
    return Work(40 * reached * pairs + 16 * pixels, 12 * evaluations + 10 * blended * pixels)


def count_blend_backward(pairs: int, pixels: int, reached: float, blended: float) -> Work:
    """Count the work of blending's backward pass; the arguments are those of `count_blend`.

    It reads the pairs again (40 bytes), and T and the gradients of rgb and T (20 bytes per pixel). It writes 11 sums
    per pair (44 bytes). An evaluation costs 12 operations as before, and a blended one 40 more (alpha's gradient 12;
    conic, mean and opacity 17; 11 sums over pixels).
    """
    evaluations = reached * pairs * TILE_PIXELS
    return Work(84 * reached * pairs + 20 * pixels, 12 * evaluations + 40 * blended * pixels)


def count_hash_encode(points: int, levels: int, rows: int, features: int = 2) -> Work:
    """Count the work of the hash encoding.

    It reads 3 coordinates per point and the table rows that the points can need, and writes the features. The table is
    read once, with at most 8 rows per point and level. The operations per point and level are 9 for the cell, 16 for
    the weights, 24 for the rows' hashes, and a multiply-add for each feature of 8 corners.
    """
    table = 4 * features * min(rows, 8 * points * levels)
    return Work(12 * points + 4 * features * levels * points + table, points * levels * (49 + 16 * features))


def count_hash_encode_backward(points: int, levels: int, rows: int, features: int = 2) -> Work:
    """Count the work of the hash encoding's backward pass.

    It reads coordinates and feature gradients, and writes the table's gradient.
    """
    work = count_hash_encode(points, levels, 0, features)
    return Work(work.bytes + 4 * features * rows, work.flops)


def count_mlp(rows: int, widths: Sequence[int], mixed: bool) -> Work:
    """Count the work of an MLP, which reads x and the weights and writes y: one multiply-add per row and weight."""
    weights = sum(i * o for i, o in zip(widths, widths[1:], strict=False))
    return Work(4 * rows * (widths[0] + widths[-1]) + 4 * weights, 2 * rows * weights, "bf16" if mixed else "fp32")


def count_mlp_backward(rows: int, widths: Sequence[int], mixed: bool) -> Work:
    """Count the work of an MLP's backward pass.

    It reads x and the gradient of y, and writes the gradient of x. The arithmetic is that of the hidden layers once
    more, then of two products per layer.
    """
    forward = count_mlp(rows, widths, mixed)
    hidden = count_mlp(rows, widths[:-1], mixed)
    return Work(forward.bytes + 4 * rows * widths[0], 2 * forward.flops + hidden.flops, forward.unit)


def count_photometric_loss(pixels: int) -> Work:
    """Count the work of the loss and its gradient.

    They read two pictures and write one, with 3 float32 per pixel each. A channel takes 5 blurs and 3 more for the
    gradient, each with two passes of 11 multiply-adds, and 40 other operations.
    """
    return Work(36 * pixels, 3 * pixels * (8 * 2 * 2 * SSIM_WINDOW_TAPS + 40))


def count_adam(parameters: int) -> Work:
    """Count the work of an Adam step.

    It reads value, gradient and both moments, and writes all but the gradient. A parameter takes 14 operations.
    """
    return Work(28 * parameters, 14 * parameters)


def count_decode(gaussians: int, widths: Sequence[int], levels: int, rows: int, mixed: bool) -> Work:
    """Count the work of decoding positions and explicit logits to activated values.

    It reads 3 coordinates, the table once, and at most one logit for each output; it writes the outputs. The features
    need not go through memory. The arithmetic is that of the encoding, the decoder, and 10 operations for each output.
    """
    encoding, decoder = count_hash_encode(gaussians, levels, rows), count_mlp(gaussians, widths, mixed)
    features = 4 * 2 * levels * gaussians
    outputs = gaussians * widths[-1]
    bytes_moved = encoding.bytes - features + 8 * outputs
    return Work(bytes_moved, encoding.flops + decoder.flops + 10 * outputs, decoder.unit)


def count_shade(gaussians: int, widths: Sequence[int], mixed: bool) -> Work:
    """Count the work of shading.

    It reads position 3, colour logits 3 and the position's part of the first layer, and writes 3 colours. The
    arithmetic is the decoder's on the encoded direction, and 60 operations for the encoding and the sigmoids.

    Args:
        gaussians: number of Gaussians.
        widths: widths of the encoded direction, the hidden layers and the colours (3).
        mixed: whether the products run in bfloat16.
    """
    decoder = count_mlp(gaussians, widths, mixed)
    bytes_moved = gaussians * (4 * 9 + (2 if mixed else 4) * widths[1])
    return Work(bytes_moved, decoder.flops + 60 * gaussians, decoder.unit)


def count_project_shaded(gaussians: int, drawn: int, widths: Sequence[int], mixed: bool) -> Work:
    """Count the work of projection and shading together.

    The bytes are those of `count_project` for all Gaussians and of `count_shade` for drawn ones, with the positions
    read once. The arithmetic is that of shading, because the projection's is a few percent of it and runs on other
    units at the same time.

    Args:
        gaussians: number of Gaussians.
        drawn: number of Gaussians that are drawn.
        widths, mixed: as for `count_shade`.
    """
    shading = count_shade(drawn, widths, mixed)
    return Work(count_project(gaussians).bytes + shading.bytes - 12 * drawn, shading.flops, shading.unit)


def count_background(
    pixels: int, nodes: int, needed: int, widths: Sequence[int], levels: int, rows: int, mixed: bool
) -> Work:
    """Count the work of the background's grid.

    It reads T of each pixel and the table rows that the needed nodes can use, and writes 3 colours of each node. The
    arithmetic is that of the encoding and the decoder at needed nodes, and 130 operations each: 70 for the ray, its
    point on the sphere and the contraction, and 60 for the encoded direction and the sigmoids.
    """
    encoding, decoder = count_hash_encode(needed, levels, rows), count_mlp(needed, widths, mixed)
    table = encoding.bytes - needed * (12 + 8 * levels)
    return Work(4 * pixels + 12 * nodes + table, encoding.flops + decoder.flops + 130 * needed, decoder.unit)

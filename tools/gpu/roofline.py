"""The least work of each operation, counted from the sizes of a call: bytes through memory and arithmetic.

Bytes: every input read once and every output written once, float32 unless said otherwise; what an implementation
reads again, or keeps between its kernels, is its own affair and shows as a lower share of the roofline. Operations:
one for each addition, multiplication, comparison and special function, two for a multiply-add.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from tools.gpu.timing import Rates

TILE_PIXELS = 16 * 16
RADIX_BITS = 8  # of a key that one pass of a radix sort settles
TAPS = 11  # of the SSIM window


@dataclass(frozen=True)
class Work:
    """Bytes moved and operations done by one call.

    Attributes:
        bytes, flops: the counts.
        unit: which rate of `Rates` the arithmetic is held against, "fp32" or "bf16".
    """

    bytes: float
    flops: float
    unit: str = "fp32"

    def __add__(self, other: Work) -> Work:
        return Work(self.bytes + other.bytes, self.flops + other.flops, self.unit)

    def shares(self, ms: float, rates: Rates) -> tuple[float, float]:
        """Fractions of the measured copy bandwidth and of the measured arithmetic rate that a time comes to."""
        seconds = 1e-3 * ms
        return self.bytes / seconds / rates.copy, self.flops / seconds / getattr(rates, self.unit)

    def least_ms(self, rates: Rates) -> float:
        """The roofline: no call can be faster."""
        return 1e3 * max(self.bytes / rates.copy, self.flops / getattr(rates, self.unit))


def project(gaussians: int) -> Work:
    """Reads mean 3, quaternion 4, scale 3, opacity 1; writes mean2d 2, conic 3, depth 1, opacity 1 (44 + 28 bytes).

    To the camera 18, rotation matrix 30, J R Q S 45, covariance 18, determinant and inverse 20, the rest 15: 146.
    """
    return Work(72 * gaussians, 146 * gaussians)


def project_backward(gaussians: int) -> Work:
    """Reads the same 11 numbers and gradients of mean2d 2, conic 3, opacity 1; writes 11. Twice the arithmetic."""
    return Work(112 * gaussians, 292 * gaussians)


def sort_bytes(items: int, key_bits: int) -> int:
    """Bytes that a radix sort of 4-byte keys with 4-byte values moves: a read and a write of both in each pass."""
    return 16 * items * -(-key_bits // RADIX_BITS)


def bin_pairs(gaussians: int, pairs: int, tiles: int) -> Work:
    """Order Gaussians by depth (32 bits), write a tile and an index for each pair, order pairs by tile.

    Reads 7 numbers a Gaussian. Arithmetic is nothing beside it: 20 operations a Gaussian, 10 a pair.
    """
    sorting = sort_bytes(gaussians, 32) + sort_bytes(pairs, max(1, (tiles - 1).bit_length()))
    return Work(28 * gaussians + 8 * pairs + sorting, 20 * gaussians + 10 * pairs)


def blend(pairs: int, pixels: int, reached: float, blended: float) -> Work:
    """Reads index 1, mean2d 2, conic 3, opacity 1, colour 3 of each pair (40 bytes); writes rgb and T (16 a pixel).

    Args:
        reached: mean share of a tile's pairs that come before all its pixels are finished.
        blended: mean number of Gaussians that add to a pixel.

    A pair reached costs 12 operations at each of 256 pixels (offset 2, exponent 8, exp 1, opacity 1), one that is
    blended 10 more (threshold, cut, weight, three multiply-adds, T).
    """
    evaluations = reached * pairs * TILE_PIXELS
    return Work(40 * reached * pairs + 16 * pixels, 12 * evaluations + 10 * blended * pixels)


def blend_backward(pairs: int, pixels: int, reached: float, blended: float) -> Work:
    """Reads the pairs again (40 bytes), T and gradients of rgb and T (20 a pixel); writes 11 sums a pair (44 bytes).

    12 operations an evaluation as before; one that is blended costs 40 more (alpha's gradient 12, conic, mean and
    opacity 17, 11 sums over pixels).
    """
    evaluations = reached * pairs * TILE_PIXELS
    return Work(84 * reached * pairs + 20 * pixels, 12 * evaluations + 40 * blended * pixels)


def hash_encode(points: int, levels: int, rows: int, features: int = 2) -> Work:
    """Reads 3 coordinates a point and the table rows that it can need; writes the features.

    The table is counted once, at most 8 rows a point and level. A point and level costs 9 for the cell, 16 for the
    weights, 24 for the rows' hashes and a multiply-add for each feature of 8 corners.
    """
    table = 4 * features * min(rows, 8 * points * levels)
    return Work(12 * points + 4 * features * levels * points + table, points * levels * (49 + 16 * features))


def hash_encode_backward(points: int, levels: int, rows: int, features: int = 2) -> Work:
    """Reads coordinates and the gradient of the features; writes the whole table's gradient."""
    work = hash_encode(points, levels, 0, features)
    return Work(work.bytes + 4 * features * rows, work.flops)


def mlp(rows: int, widths: Sequence[int], mixed: bool) -> Work:
    """Reads x, writes y; weights are nothing beside them. A multiply-add for each row and weight."""
    weights = sum(i * o for i, o in zip(widths, widths[1:], strict=False))
    return Work(4 * rows * (widths[0] + widths[-1]) + 4 * weights, 2 * rows * weights, "bf16" if mixed else "fp32")


def mlp_backward(rows: int, widths: Sequence[int], mixed: bool) -> Work:
    """Reads x and the gradient of y, writes that of x; the hidden layers again, then two products a layer."""
    forward = mlp(rows, widths, mixed)
    hidden = mlp(rows, widths[:-1], mixed)
    return Work(forward.bytes + 4 * rows * widths[0], 2 * forward.flops + hidden.flops, forward.unit)


def photometric_loss(pixels: int) -> Work:
    """Loss and gradient: reads two pictures, writes one, 3 float32 a pixel each.

    A channel takes 5 blurs, and 3 more for the gradient, each two passes of 11 multiply-adds; and 40 operations.
    """
    return Work(36 * pixels, 3 * pixels * (8 * 2 * 2 * TAPS + 40))


def adam(parameters: int) -> Work:
    """Reads value, gradient and both moments, writes all but the gradient; 14 operations."""
    return Work(28 * parameters, 14 * parameters)


def decode(gaussians: int, widths: Sequence[int], levels: int, rows: int, mixed: bool) -> Work:
    """Positions and explicit logits to activated values, with the field in between: no feature need reach memory.

    Reads 3 coordinates, the table once and one logit for each output or fewer; writes the outputs. The arithmetic is
    that of the encoding, the decoder, and 10 operations for each output.
    """
    encoding, decoder = hash_encode(gaussians, levels, rows), mlp(gaussians, widths, mixed)
    features = 4 * 2 * levels * gaussians
    outputs = gaussians * widths[-1]
    bytes_moved = encoding.bytes - features + 8 * outputs
    return Work(bytes_moved, encoding.flops + decoder.flops + 10 * outputs, decoder.unit)


def shade(gaussians: int, widths: Sequence[int], mixed: bool) -> Work:
    """Reads position 3, colour logits 3 and the first layer as far as the place decides it; writes 3 colours.

    The arithmetic is the decoder's on the encoded direction, and 60 operations for that and the sigmoids.

    Args:
        widths: encoded direction, hidden layers, 3.
    """
    decoder = mlp(gaussians, widths, mixed)
    bytes_moved = gaussians * (4 * 9 + (2 if mixed else 4) * widths[1])
    return Work(bytes_moved, decoder.flops + 60 * gaussians, decoder.unit)


def project_shaded(gaussians: int, drawn: int, widths: Sequence[int], mixed: bool) -> Work:
    """Moves what `project` does of all Gaussians, and what `shade` does, but for the position, of those that are drawn.

    The arithmetic is the shading's: that of the projection, a few hundredths of it, runs beside it on other units.

    Args:
        widths: as for `shade`.
    """
    shading = shade(drawn, widths, mixed)
    return Work(project(gaussians).bytes + shading.bytes - 12 * drawn, shading.flops, shading.unit)


def background(
    pixels: int, nodes: int, needed: int, widths: Sequence[int], levels: int, rows: int, mixed: bool
) -> Work:
    """Reads T of each pixel and the table rows that needed nodes can ask for; writes 3 colours of each node.

    The arithmetic is that of the encoding and the decoder at needed nodes, and there 130 operations: the ray, its point
    on the sphere and the contraction 70, the encoded direction and the sigmoids 60.
    """
    encoding, decoder = hash_encode(needed, levels, rows), mlp(needed, widths, mixed)
    table = encoding.bytes - needed * (12 + 8 * levels)
    return Work(4 * pixels + 12 * nodes + table, encoding.flops + decoder.flops + 130 * needed, decoder.unit)

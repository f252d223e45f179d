"""Encodes viewing directions in Triton.

Kernels that decode colours call `encode_block`; `encode_views` launches a kernel that only encodes.
"""

from __future__ import annotations

import triton
import triton.language as tl
from torch import Tensor

from hyrfpack.ops.gpu_rows import count_used_rows

_POINTS_PER_PROGRAM = 128


@triton.jit
def normalize_block(x, y, z):
    """Return blocks of vectors scaled to length 1."""
    inverse = 1 / tl.maximum(tl.sqrt(x * x + y * y + z * z), 1e-12)
    return x * inverse, y * inverse, z * inverse


@triton.jit
def _sin_of_turns(turns):
    """Return sin(2 pi t) for t in [-1/2, 3/4], with an absolute error of 1e-7.

    The library's sine would take memory for a table that only huge arguments need.
    """
    turns = tl.where(turns > 0.25, 0.5 - turns, tl.where(turns < -0.25, -0.5 - turns, turns))
    square = turns * turns
    polynomial = ((39.7598271 * square - 76.5811727) * square + 81.6024764) * square - 41.3416806
    return turns * (polynomial * square + 6.28318528)


@triton.jit
def encode_block(x, y, z, FREQUENCY: tl.constexpr, FIRST: tl.constexpr, HEIGHT: tl.constexpr):
    """Encode unit vectors [BLOCK] as `directions.encode_directions` does.

    Returns:
        Features FIRST to FIRST + HEIGHT as a tile [HEIGHT, BLOCK]; rows past the last feature are finite padding.
    """
    row = FIRST + tl.arange(0, HEIGHT)[:, None]
    x, y, z = x[None, :], y[None, :], z[None, :]
    if FREQUENCY:
        part = row % 12
        along = tl.where(part % 3 == 0, x, tl.where(part % 3 == 1, y, z))
        turns = along * (0.5 * (1 << part // 3).to(tl.float32))
        encoded = _sin_of_turns(turns - tl.floor(turns + 0.5) + tl.where(row < 12, 0.0, 0.25))
    else:
        encoded = tl.where(row == 0, 0.28209479177387814, 0.5462742152960396 * (x * x - y * y))
        encoded = tl.where(row == 1, 0.4886025119029199 * y, encoded)
        encoded = tl.where(row == 2, 0.4886025119029199 * z, encoded)
        encoded = tl.where(row == 3, 0.4886025119029199 * x, encoded)
        encoded = tl.where(row == 4, 1.0925484305920792 * x * y, encoded)
        encoded = tl.where(row == 5, 1.0925484305920792 * y * z, encoded)
        encoded = tl.where(row == 6, 0.31539156525252005 * (3 * z * z - 1), encoded)
        encoded = tl.where(row == 7, 1.0925484305920792 * x * z, encoded)
    return encoded


@triton.jit(do_not_specialize=["total"])
def encode_views_kernel(
    points, viewpoint, total, used, out, ROWS: tl.constexpr, FREQUENCY: tl.constexpr, BLOCK: tl.constexpr
):
    """Write the encoded directions, planar (ROWS, N), from a viewpoint (3,) to points (N, 3)."""
    index = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    count = count_used_rows(used, total)
    if tl.program_id(0) * BLOCK >= count:
        return
    live, at = index < count, points + index * 3
    x = tl.load(at, mask=live, other=0.0) - tl.load(viewpoint)
    y = tl.load(at + 1, mask=live, other=0.0) - tl.load(viewpoint + 1)
    z = tl.load(at + 2, mask=live, other=0.0) - tl.load(viewpoint + 2)
    x, y, z = normalize_block(x, y, z)
    for first in tl.static_range(0, ROWS, 16):
        row = first + tl.arange(0, 16)[:, None]
        encoded = encode_block(x, y, z, FREQUENCY, first, 16)
        tl.store(out + row.to(tl.int64) * total + index[None, :], encoded, mask=live[None, :] & (row < ROWS))


def encode_views(points: Tensor, viewpoint: Tensor, encoding: str, features: int, used: Tensor | None = None) -> Tensor:
    """Compute `directions.encode_views` without gradients; the result (N, features) is stored planar."""
    total = len(points)
    encoded = points.new_empty(features, total)
    if total:
        encode_views_kernel[(triton.cdiv(total, _POINTS_PER_PROGRAM),)](
            points.detach().contiguous(), viewpoint.detach().contiguous(), total, used, encoded,
            ROWS=features, FREQUENCY=encoding == "frequency", BLOCK=_POINTS_PER_PROGRAM, num_warps=4,
            enable_fp_fusion=True,
        )  # fmt: skip
    return encoded.T

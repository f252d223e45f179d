"""Implements the contraction in Triton: one launch, no gradients.

Other kernels call `contract_block` to contract points without storing them.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from hyrfpack.ops.gpu_rows import count_used_rows

_POINTS_PER_PROGRAM = 256


@triton.jit
def contract_block(x, y, z):
    """Contract blocks of normalised coordinates u, as `reference.contract` does."""
    largest = tl.maximum(tl.maximum(tl.maximum(tl.abs(x), tl.abs(y)), tl.abs(z)), 1.0)
    a, b, c = x / largest, y / largest, z / largest
    radius = tl.maximum(tl.sqrt_rn(a * a + b * b + c * c), 1 / largest) * largest
    shrink = 0.25 * (2 - 1 / radius)
    return shrink * (x / radius) + 0.5, shrink * (y / radius) + 0.5, shrink * (z / radius) + 0.5


@triton.jit(do_not_specialize=["total"])
def contract_points(points, half_extent, total, used, cube, BLOCK: tl.constexpr):
    """Contract `points` (total, 3) into `cube` (total, 3); half_extent is a tuple of 3 numbers."""
    index = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    count = count_used_rows(used, total)
    if tl.program_id(0) * BLOCK >= count:
        return
    live, at = index < count, points + index * 3
    x = tl.load(at, mask=live, other=0.0) / half_extent[0]
    y = tl.load(at + 1, mask=live, other=0.0) / half_extent[1]
    z = tl.load(at + 2, mask=live, other=0.0) / half_extent[2]
    u, v, w = contract_block(x, y, z)
    at = cube + index * 3
    tl.store(at, u, mask=live)
    tl.store(at + 1, v, mask=live)
    tl.store(at + 2, w, mask=live)


def contract(points: Tensor, half_extent: tuple[float, float, float], used: Tensor | None = None) -> Tensor:
    """Compute `hyrfpack.ops.contraction.contract` without gradients."""
    points = points.detach().contiguous()
    cube, total = torch.empty_like(points), points.numel() // 3
    if total:
        contract_points[(triton.cdiv(total, _POINTS_PER_PROGRAM),)](
            points, tuple(half_extent), total, used, cube, BLOCK=_POINTS_PER_PROGRAM, num_warps=4, enable_fp_fusion=True
        )
    return cube

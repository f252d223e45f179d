"""Culling in Triton: one launch to look, one to list, and the only question to the device between them."""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from hyrfpack.ops.rasterize.gpu_project import (
    BLOCK,
    WARPS,
    camera_numbers,
    in_frustum,
    is_finite,
    load_camera,
    load_rows_3,
)


@triton.jit(do_not_specialize=["total"])
def look(positions, camera, total, inside, broken, BLOCK: tl.constexpr):
    """Write which positions (N, 3) are in the frustum, (N,) uint8; broken, zero before, is 1 if one is not finite."""
    index = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = index < total
    x, y, z = load_rows_3(positions, index, live)
    finite = is_finite(x) & is_finite(y) & is_finite(z)
    tl.store(inside + index, in_frustum((x, y, z), load_camera(camera)).to(tl.uint8), mask=live)
    one = tl.full([BLOCK], 1, tl.int64)
    tl.store(broken + tl.zeros_like(index), one, mask=live & (finite == 0))  # all who write, write the same


@triton.jit(do_not_specialize=["total"])
def list_inside(inside, ends, total, indices, BLOCK: tl.constexpr):
    """Write the numbers of those inside, in order; ends: (N,) int64 how many there are up to each."""
    index = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    chosen = tl.load(inside + index, mask=index < total, other=0) != 0
    tl.store(indices + tl.load(ends + index, mask=chosen, other=1) - 1, index.to(tl.int64), mask=chosen)


def frustum_cull(
    positions: Tensor,
    pose: Tensor,
    intrinsics: tuple[float, float, float, float],
    width: int,
    height: int,
    near: float,
    tolerance: float,
) -> Tensor:
    """As `hyrfpack.ops.rasterize.cull.frustum_cull`. Waits for the device once."""
    total, device = len(positions), positions.device
    if not total:
        return torch.empty(0, dtype=torch.int64, device=device)
    camera = camera_numbers(pose, intrinsics, width, height, near, device, tolerance)
    inside = torch.empty(total, dtype=torch.uint8, device=device)
    numbers = torch.empty(1 + total, dtype=torch.int64, device=device)
    numbers[:1].zero_()  # numbers[0] = 0 would copy from the host, and wait
    programs = (triton.cdiv(total, BLOCK),)
    look[programs](
        positions.detach().contiguous(), camera, total, inside, numbers, BLOCK=BLOCK, num_warps=WARPS,
        enable_fp_fusion=True,
    )  # fmt: skip
    torch.cumsum(inside, 0, dtype=torch.int64, out=numbers[1:])
    broken, count = numbers[::total].tolist()
    if broken:
        raise FloatingPointError("positions hold NaN or infinity")
    indices = torch.empty(count, dtype=torch.int64, device=device)
    if count:
        list_inside[programs](inside, numbers[1:], total, indices, BLOCK=BLOCK, num_warps=WARPS)
    return indices

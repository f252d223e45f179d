"""Culls Gaussians in Triton: one launch tests all positions, another lists the result.

The host synchronises with the device once, between the two launches.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from hyrfpack.ops.rasterize.gpu_project import (
    GAUSSIANS_PER_PROGRAM,
    WARPS_PER_PROGRAM,
    in_frustum,
    is_finite,
    load_camera,
    load_rows_3,
    pack_camera,
)
from hyrfpack.ops.viewport import Viewport


@triton.jit(do_not_specialize=["total"])
def frustum_kernel(positions, camera, total, inside, has_nonfinite, BLOCK: tl.constexpr):
    """Write whether each position (N, 3) is in the frustum, (N,) uint8, and flag positions that are not finite.

    has_nonfinite: int64, zero before the launch, set to 1 if any position is NaN or infinite.
    """
    index = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = index < total
    x, y, z = load_rows_3(positions, index, live)
    finite = is_finite(x) & is_finite(y) & is_finite(z)
    tl.store(inside + index, in_frustum((x, y, z), load_camera(camera)).to(tl.uint8), mask=live)
    one = tl.full([BLOCK], 1, tl.int64)
    # All programs that write store the same value, so that there is no race.
    tl.store(has_nonfinite + tl.zeros_like(index), one, mask=live & (finite == 0))


@triton.jit(do_not_specialize=["total"])
def list_inside_kernel(inside, ends, total, indices, BLOCK: tl.constexpr):
    """Write the indices of the positions inside, in order; ends: (N,) int64, the running count of those inside."""
    index = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    chosen = tl.load(inside + index, mask=index < total, other=0) != 0
    tl.store(indices + tl.load(ends + index, mask=chosen, other=1) - 1, index.to(tl.int64), mask=chosen)


def frustum_cull(positions: Tensor, viewport: Viewport, near: float, tolerance: float) -> Tensor:
    """Compute `hyrfpack.ops.rasterize.cull.frustum_cull`. Synchronises with the device once."""
    total, device = len(positions), positions.device
    if not total:
        return torch.empty(0, dtype=torch.int64, device=device)
    camera = pack_camera(viewport, near, device, tolerance)
    inside = torch.empty(total, dtype=torch.uint8, device=device)
    flag_and_ends = torch.empty(1 + total, dtype=torch.int64, device=device)
    flag_and_ends[:1].zero_()  # An assignment of 0 would copy it from the host and block.
    programs = (triton.cdiv(total, GAUSSIANS_PER_PROGRAM),)
    frustum_kernel[programs](
        positions.detach().contiguous(), camera, total, inside, flag_and_ends, BLOCK=GAUSSIANS_PER_PROGRAM,
        num_warps=WARPS_PER_PROGRAM, enable_fp_fusion=True,
    )  # fmt: skip
    torch.cumsum(inside, 0, dtype=torch.int64, out=flag_and_ends[1:])
    has_nonfinite, count = flag_and_ends[::total].tolist()
    if has_nonfinite:
        raise FloatingPointError("positions hold NaN or infinity")
    indices = torch.empty(count, dtype=torch.int64, device=device)
    if count:
        list_inside_kernel[programs](
            inside, flag_and_ends[1:], total, indices, BLOCK=GAUSSIANS_PER_PROGRAM, num_warps=WARPS_PER_PROGRAM
        )
    return indices

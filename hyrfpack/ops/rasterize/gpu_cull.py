"""Culls Gaussians in Triton: one launch tests all positions, another lists the result.

Between the two launches the host waits for the number of Gaussians in view, unless it reserves memory for the result.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from hyrfpack.ops.gpu_rows import partition_rows
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


def frustum_cull(positions: Tensor, viewport: Viewport, near: float, tolerance: float) -> Tensor:
    """Compute `hyrfpack.ops.rasterize.cull.frustum_cull`. Synchronises with the device once."""
    if not len(positions):
        return torch.empty(0, dtype=torch.int64, device=positions.device)
    inside, flag_and_ends = _test_positions(positions, viewport, near, tolerance)
    has_nonfinite, count = flag_and_ends[:: len(positions)].tolist()
    if has_nonfinite:
        raise FloatingPointError("positions hold NaN or infinity")
    return partition_rows(inside, flag_and_ends[1:], count)[0]


def frustum_cull_into(
    positions: Tensor, viewport: Viewport, near: float, tolerance: float, reserve: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Compute `hyrfpack.ops.rasterize.cull.frustum_cull_into`."""
    inside, flag_and_ends = _test_positions(positions, viewport, near, tolerance)
    index, used = partition_rows(inside, flag_and_ends[1:], min(reserve, len(positions)))
    return index, used, flag_and_ends[:: len(positions)]


def _test_positions(positions: Tensor, viewport: Viewport, near: float, tolerance: float) -> tuple[Tensor, Tensor]:
    """Test N positions, at least one, for lying in the frustum.

    Returns:
        (N,) uint8, whether each lies inside; and (1 + N,) int64, whether any of them is not finite, and the running
        count of those inside.
    """
    total, device = len(positions), positions.device
    camera = pack_camera(viewport, near, device, tolerance)
    inside = torch.empty(total, dtype=torch.uint8, device=device)
    flag_and_ends = torch.empty(1 + total, dtype=torch.int64, device=device)
    flag_and_ends[:1].zero_()  # An assignment of 0 would copy it from the host and block.
    frustum_kernel[(triton.cdiv(total, GAUSSIANS_PER_PROGRAM),)](
        positions.detach().contiguous(), camera, total, inside, flag_and_ends, BLOCK=GAUSSIANS_PER_PROGRAM,
        num_warps=WARPS_PER_PROGRAM, enable_fp_fusion=True,
    )  # fmt: skip
    torch.cumsum(inside, 0, dtype=torch.int64, out=flag_and_ends[1:])
    return inside, flag_and_ends

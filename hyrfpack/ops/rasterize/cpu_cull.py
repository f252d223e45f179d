"""Culls Gaussians in compiled code: one pass over all positions, on the shared thread pool."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from hyrfpack.ops.viewport import Viewport
from hyrfpack.parallel.compiled import compiled
from hyrfpack.parallel.pool import run_ranges

# A thread tests about this many positions in the time that another one takes to start.
_MIN_POSITIONS_PER_RANGE = 16_384
_kernel = compiled(fastmath={"contract", "nsz"}, error_model="numpy")


@_kernel
def _list_inside(start, stop, positions, axes, shift, lens, index):
    """Write which of the positions start to stop lie inside the frustum to index[start:], and return their number.

    Args:
        positions: (N, 3) float32 world units.
        axes, shift: rotation (3 x 3) and translation (3) of the pose; float64.
        lens: near plane, fx and fy, then the smallest and largest fx x / z and fy y / z; float64.
        index: (N,) int64, gets ascending rows of `positions`.

    Returns:
        The number of indices, or -1 if a position is NaN or infinite.
    """
    near, fx, fy, left, right, top, bottom = lens
    at, sum_of_zeros = start, np.float32(0.0)
    for i in range(start, stop):
        px, py, pz = positions[i, 0], positions[i, 1], positions[i, 2]
        sum_of_zeros += (px - px) + (py - py) + (pz - pz)  # NaN if one of them is NaN or infinite
        x = axes[0][0] * px + axes[0][1] * py + axes[0][2] * pz + shift[0]
        y = axes[1][0] * px + axes[1][1] * py + axes[1][2] * pz + shift[1]
        z = axes[2][0] * px + axes[2][1] * py + axes[2][2] * pz + shift[2]
        # The limits are multiplied by z, because a division by z would need a guard against 0.
        u, v = fx * x, fy * y
        inside = (z > near) & (u > left * z) & (u < right * z) & (v > top * z) & (v < bottom * z)
        index[at] = i
        at += inside
    return -1 if math.isnan(sum_of_zeros) else at - start


@torch.no_grad()
def frustum_cull(positions: Tensor, viewport: Viewport, near: float, tolerance: float) -> Tensor:
    """Compute `hyrfpack.ops.rasterize.cull.frustum_cull` in float64."""
    rows = positions.detach().contiguous().numpy()
    pose = viewport.pose.detach().double().tolist()
    axes, shift = tuple(tuple(row[:3]) for row in pose[:3]), tuple(row[3] for row in pose[:3])
    fx, fy, cx, cy = viewport.intrinsics
    margin_x, margin_y = tolerance * viewport.width / 2, tolerance * viewport.height / 2
    edges = -margin_x - cx, viewport.width + margin_x - cx, -margin_y - cy, viewport.height + margin_y - cy
    lens = tuple(float(number) for number in (near, fx, fy, *edges))
    index = np.empty(len(rows), np.int64)
    counts: dict[int, int] = {}

    def task(start: int, stop: int) -> None:
        counts[start] = _list_inside(start, stop, rows, axes, shift, lens, index)

    run_ranges(task, len(rows), _MIN_POSITIONS_PER_RANGE)
    if any(count < 0 for count in counts.values()):
        raise FloatingPointError("positions hold NaN or infinity")
    parts = [index[start : start + count] for start, count in sorted(counts.items())]
    return torch.from_numpy(np.concatenate([index[:0], *parts]))

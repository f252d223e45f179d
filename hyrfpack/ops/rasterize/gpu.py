"""Rasterising on the GPU: Triton kernels behind one autograd.Function.

Project, sort by depth, list pairs, sort them by tile, blend. `draw` is all but the projection, for projections that
come from elsewhere.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import triton
from torch import Tensor
from torch.autograd.function import once_differentiable

from hyrfpack.ops.rasterize import gpu_blend, gpu_project
from hyrfpack.ops.rasterize.gpu_bin import Pairs, bin_pairs
from hyrfpack.ops.rasterize.gpu_project import Projection

# Gaussians and gradient rows of each that a program sums at once: most Gaussians lie in fewer tiles than this.
_SUM_BLOCK, _SUM_SLOTS, _SUM_WARPS = 8, 16, 4


@dataclass(frozen=True)
class Drawn:
    """A picture and what its backward needs.

    Attributes:
        rgb: (H, W, 3).
        transmittance: (H, W).
        depth: (H, W), or None.
        pairs: what each tile blends.
        blended: (tiles + 1,) int32 after how many pairs each tile was finished.
    """

    rgb: Tensor
    transmittance: Tensor
    depth: Tensor | None
    pairs: Pairs
    blended: Tensor


def draw(projection: Projection, width: int, height: int, transmittance_min: float, depth: bool) -> Drawn:
    """Bin and blend projected Gaussians. Waits for the device once.

    Raises:
        MemoryError: more than 2^31 - 64 pairs.
    """
    pairs = bin_pairs(projection, width, height)
    device = projection.keys.device
    rgb = torch.empty(height, width, 3, device=device)
    transmittance = torch.empty(height, width, device=device)
    depths = torch.empty(height, width, device=device) if depth else None
    tiles = len(pairs.starts) - 1
    blended = torch.empty(tiles, dtype=torch.int32, device=device)
    gpu_blend.blend[(tiles,)](
        pairs.starts, pairs.owners, projection.records, width, height, transmittance_min,
        rgb, transmittance, depths, blended, DEPTH=depth, num_warps=gpu_blend.WARPS, enable_fp_fusion=True,
    )  # fmt: skip
    return Drawn(rgb, transmittance, depths, pairs, blended)


@dataclass(frozen=True)
class _View:
    """What of the call is not a tensor to differentiate. camera: of `gpu_project.camera_numbers`."""

    camera: Tensor
    width: int
    height: int
    antialiased: bool
    transmittance_min: float
    depth: bool
    absgrad: Tensor | None


def rasterize(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    camera_from_world: Tensor,
    intrinsics: tuple[float, float, float, float],
    width: int,
    height: int,
    *,
    near: float,
    antialiased: bool,
    transmittance_min: float,
    depth: bool,
    absgrad: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor | None, Tensor, int, dict[str, float], tuple[str, ...]]:
    """Arguments and results (a tuple in the order of the fields) as in `hyrfpack.ops.rasterize.rasterize`."""
    camera = gpu_project.camera_numbers(camera_from_world, intrinsics, width, height, near, means.device)
    absgrad = None if absgrad is None else absgrad.detach()
    view = _View(camera, int(width), int(height), bool(antialiased), float(transmittance_min), bool(depth), absgrad)
    report: dict = {}
    rgb, transmittance, depths, visible = _Rasterize.apply(means, quats, scales, opacities, colors, view, report)
    return rgb, transmittance, depths, visible, report["pairs"], {}, report["nonfinite"]


def _project(inputs: tuple[Tensor, ...], view: _View) -> Projection:
    total = len(inputs[0])
    projection = Projection.empty(total, inputs[0].device)
    if total:
        gpu_project.project[(triton.cdiv(total, gpu_project.BLOCK),)](
            *inputs, view.camera, total, view.width, view.height,
            projection.records, projection.keys, projection.counts, projection.visible, projection.numbers,
            ANTIALIASED=view.antialiased, BLOCK=gpu_project.BLOCK, num_warps=gpu_project.WARPS, enable_fp_fusion=True,
        )  # fmt: skip
    return projection


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx, means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor, view: _View, report: dict
    ) -> tuple[Tensor, Tensor, Tensor | None, Tensor]:
        inputs = tuple(tensor.detach().contiguous() for tensor in (means, quats, scales, opacities, colors))
        projection = _project(inputs, view)
        drawn = draw(projection, view.width, view.height, view.transmittance_min, view.depth)
        report["pairs"], report["nonfinite"] = len(drawn.pairs.owners), drawn.pairs.nonfinite
        visible = projection.visible.view(torch.bool)
        ctx.save_for_backward(*inputs[:4], drawn.rgb, drawn.transmittance)
        ctx.projection, ctx.pairs, ctx.blended, ctx.view = projection, drawn.pairs, drawn.blended, view
        ctx.mark_non_differentiable(*([visible] if drawn.depth is None else [visible, drawn.depth]))
        return drawn.rgb, drawn.transmittance, drawn.depth, visible

    @staticmethod
    @once_differentiable
    def backward(
        ctx, grad_rgb: Tensor, grad_transmittance: Tensor, _grad_depth: Tensor | None, _grad_visible: Tensor | None
    ) -> tuple[Tensor | None, ...]:
        *inputs, rgb, transmittance = ctx.saved_tensors
        projection, pairs, view = ctx.projection, ctx.pairs, ctx.view
        total, count, with_absgrad = len(inputs[0]), len(pairs.owners), view.absgrad is not None
        grads = tuple(torch.empty_like(tensor) for tensor in (*inputs, inputs[0]))
        if not total:
            return *grads, None, None
        rows = torch.empty(count, gpu_project.ROW.value // 2, dtype=torch.int64, device=rgb.device)
        sums = rows.view(torch.float32)
        if count:
            gpu_blend.blend_backward[(len(ctx.blended),)](
                pairs.starts, pairs.owners, pairs.slots, ctx.blended, projection.records,
                view.width, view.height, view.transmittance_min,
                rgb, transmittance, grad_rgb.contiguous(), grad_transmittance.contiguous(), rows,
                ABSGRAD=with_absgrad, num_warps=gpu_blend.WARPS, enable_fp_fusion=True,
            )  # fmt: skip
            gpu_blend.sum_rows[(triton.cdiv(total, _SUM_BLOCK),)](
                sums, pairs.begins, projection.counts, total,
                ABSGRAD=with_absgrad, BLOCK=_SUM_BLOCK, SLOTS=_SUM_SLOTS, num_warps=_SUM_WARPS, enable_fp_fusion=True,
            )  # fmt: skip
        gpu_project.project_backward[(triton.cdiv(total, gpu_project.BLOCK),)](
            sums, pairs.begins, projection.counts, *inputs, view.camera, total, *grads,
            view.absgrad, *(view.absgrad.stride() if with_absgrad else (0, 0)),
            ANTIALIASED=view.antialiased, ABSGRAD=with_absgrad,
            BLOCK=gpu_project.BLOCK, num_warps=gpu_project.WARPS, enable_fp_fusion=True,
        )  # fmt: skip
        return *grads, None, None

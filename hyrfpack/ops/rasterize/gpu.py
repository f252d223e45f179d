"""Rasterises on the GPU with Triton kernels, behind one autograd.Function.

The steps are: project, sort by depth, list pairs, sort them by tile, blend. `bin_and_blend` does all steps after the
projection, so that other kernels can project.
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
from hyrfpack.ops.rasterize.inputs import Gaussians3D, RasterSettings
from hyrfpack.ops.viewport import Viewport

# Of 13 shapes measured on an H200, this one takes 0.34 to 0.58 of the time of 8 Gaussians and four warps.
_SUM_GAUSSIANS_PER_PROGRAM = 4
_SUM_ROWS_PER_LOAD = 16  # Most Gaussians lie in fewer tiles than this, so that one load gets all their gradient rows.
_SUM_WARPS_PER_PROGRAM = 2


@dataclass(frozen=True)
class BlendedImage:
    """An image and the data that its backward pass needs.

    Attributes:
        rgb: (H, W, 3) colours, without background.
        transmittance: (H, W) the share of light that passes all Gaussians, 0 to 1.
        depth: (H, W) mean camera z in world units, 0 where nothing is hit; or None.
        pairs: the pairs that each tile blends.
        blended: (tiles + 1,) int32, the number of pairs after which each tile was finished.
    """

    rgb: Tensor
    transmittance: Tensor
    depth: Tensor | None
    pairs: Pairs
    blended: Tensor


def bin_and_blend(
    projection: Projection, viewport: Viewport, settings: RasterSettings, reserve: int | None = None
) -> BlendedImage:
    """Bin and blend projected Gaussians. Synchronises with the device once, unless pairs are reserved.

    Raises:
        MemoryError: there are more than 2^31 - 64 pairs.
    """
    width, height, depth = int(viewport.width), int(viewport.height), bool(settings.depth)
    pairs = bin_pairs(projection, width, height, reserve)
    device = projection.keys.device
    rgb = torch.empty(height, width, 3, device=device)
    transmittance = torch.empty(height, width, device=device)
    depths = torch.empty(height, width, device=device) if depth else None
    tiles = len(pairs.tile_starts) - 1
    blended = torch.empty(tiles, dtype=torch.int32, device=device)
    gpu_blend.blend[(tiles,)](
        pairs.tile_starts, pairs.owners, projection.records, width, height, float(settings.transmittance_min),
        rgb, transmittance, depths, blended, DEPTH=depth, num_warps=gpu_blend.WARPS_PER_TILE, enable_fp_fusion=True,
    )  # fmt: skip
    return BlendedImage(rgb, transmittance, depths, pairs, blended)


@dataclass(frozen=True)
class _View:
    """The arguments of `rasterize` that get no gradients; `camera` is the result of `gpu_project.pack_camera`."""

    camera: Tensor
    viewport: Viewport
    settings: RasterSettings
    absgrad: Tensor | None = None
    used: Tensor | None = None
    reserve: int | None = None


def rasterize(
    gaussians: Gaussians3D,
    colors: Tensor,
    viewport: Viewport,
    settings: RasterSettings,
    absgrad: Tensor | None,
    used: Tensor | None = None,
    reserve: int | None = None,
) -> tuple[Tensor, Tensor, Tensor | None, Tensor, int, dict[str, float], tuple[str, ...], Tensor | None]:
    """Compute `hyrfpack.ops.rasterize.rasterize`; the result is a tuple of the fields of `Rasterization` in order."""
    camera = gpu_project.pack_camera(
        viewport, settings.near, colors.device, low_pass_variance=settings.low_pass_variance
    )
    view = _View(camera, viewport, settings, None if absgrad is None else absgrad.detach(), used, reserve)
    report: dict = {}
    rgb, transmittance, depths, visible = _Rasterize.apply(*gaussians, colors, view, report)
    return rgb, transmittance, depths, visible, report["pairs"], {}, report["nonfinite"], report["demand"]


def _project(gaussians: Gaussians3D, colors: Tensor, view: _View) -> Projection:
    """Project all Gaussians."""
    total = len(colors)
    projection = Projection.empty(total, colors.device)
    if total:
        gpu_project.project[(triton.cdiv(total, gpu_project.GAUSSIANS_PER_PROGRAM),)](
            gaussians, colors, view.camera, total, view.used, int(view.viewport.width), int(view.viewport.height),
            projection,
            ANTIALIASED=bool(view.settings.antialiased), BLOCK=gpu_project.GAUSSIANS_PER_PROGRAM,
            num_warps=gpu_project.WARPS_PER_PROGRAM, enable_fp_fusion=True,
        )  # fmt: skip
    return projection


class _Rasterize(torch.autograd.Function):
    """Autograd function of `rasterize`."""

    @staticmethod
    def forward(
        ctx, means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor, view: _View, report: dict
    ) -> tuple[Tensor, Tensor, Tensor | None, Tensor]:
        inputs = tuple(tensor.detach().contiguous() for tensor in (means, quats, scales, opacities, colors))
        projection = _project(Gaussians3D(*inputs[:4]), inputs[4], view)
        image = bin_and_blend(projection, view.viewport, view.settings, view.reserve)
        pairs = image.pairs
        report |= {"pairs": len(pairs.owners), "nonfinite": pairs.nonfinite, "demand": pairs.demand}
        visible = projection.visible.view(torch.bool)
        ctx.save_for_backward(*inputs[:4], image.rgb, image.transmittance)
        ctx.projection, ctx.pairs, ctx.blended, ctx.view = projection, pairs, image.blended, view
        ctx.mark_non_differentiable(*([visible] if image.depth is None else [visible, image.depth]))
        return image.rgb, image.transmittance, image.depth, visible

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
        rows = _empty_rows(count, rgb.device)
        sums = rows.view(torch.float32)
        if count:
            image = BlendedImage(rgb, transmittance, None, pairs, ctx.blended)
            grads_of_image = grad_rgb.contiguous(), grad_transmittance.contiguous()
            _blend_backward(projection, image, view.viewport, view.settings, *grads_of_image, rows, with_absgrad)
            gpu_blend.sum_rows[(triton.cdiv(total, _SUM_GAUSSIANS_PER_PROGRAM),)](
                sums, pairs.slot_starts, projection.counts, total,
                ABSGRAD=with_absgrad, BLOCK=_SUM_GAUSSIANS_PER_PROGRAM, SLOTS=_SUM_ROWS_PER_LOAD,
                num_warps=_SUM_WARPS_PER_PROGRAM, enable_fp_fusion=True,
            )  # fmt: skip
        gpu_project.project_backward[(triton.cdiv(total, gpu_project.GAUSSIANS_PER_PROGRAM),)](
            sums, pairs.slot_starts, projection.counts, Gaussians3D(*inputs), view.camera, total, view.used,
            Gaussians3D(*grads[:4]), grads[4],
            view.absgrad, *(view.absgrad.stride() if with_absgrad else (0, 0)),
            ANTIALIASED=bool(view.settings.antialiased), ABSGRAD=with_absgrad,
            BLOCK=gpu_project.GAUSSIANS_PER_PROGRAM, num_warps=gpu_project.WARPS_PER_PROGRAM, enable_fp_fusion=True,
        )  # fmt: skip
        return *grads, None, None


def _empty_rows(count: int, device: torch.device) -> Tensor:
    """Return memory for the gradient rows of all pairs."""
    return torch.empty(count, gpu_project.GRADIENT_ROW_FLOATS.value // 2, dtype=torch.int64, device=device)


def _blend_backward(
    projection: Projection,
    image: BlendedImage,
    viewport: Viewport,
    settings: RasterSettings,
    grad_rgb: Tensor,
    grad_transmittance: Tensor,
    rows: Tensor,
    with_absgrad: bool,
    replayed: Tensor | None = None,
) -> None:
    """Write the gradient row of each pair, and if asked for, the transmittance that this pass has replayed."""
    pairs = image.pairs
    gpu_blend.blend_backward[(len(image.blended),)](
        pairs.tile_starts, pairs.owners, pairs.slots, image.blended, projection.records,
        int(viewport.width), int(viewport.height), float(settings.transmittance_min),
        image.rgb, image.transmittance, grad_rgb, grad_transmittance, rows, replayed,
        ABSGRAD=with_absgrad, REPLAYED=replayed is not None,
        num_warps=gpu_blend.WARPS_PER_TILE, enable_fp_fusion=True,
    )  # fmt: skip


@torch.no_grad()
def replay_transmittance(
    gaussians: Gaussians3D, colors: Tensor, viewport: Viewport, settings: RasterSettings
) -> tuple[Tensor, Tensor]:
    """Return the transmittance (H, W) of the forward pass, and that which the backward pass replays; for tests.

    All bits have to agree. Otherwise a pair near a threshold could count in one pass and not in the other.
    """
    camera = gpu_project.pack_camera(
        viewport, settings.near, colors.device, low_pass_variance=settings.low_pass_variance
    )
    projection = _project(gaussians, colors, _View(camera, viewport, settings))
    image = bin_and_blend(projection, viewport, settings)
    replayed = torch.full_like(image.transmittance, torch.nan)
    rows = _empty_rows(len(image.pairs.owners), colors.device)
    gradients = torch.ones_like(image.rgb), torch.ones_like(image.transmittance)
    _blend_backward(projection, image, viewport, settings, *gradients, rows, False, replayed)
    return image.transmittance, replayed

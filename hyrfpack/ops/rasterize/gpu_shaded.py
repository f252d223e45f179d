"""Projects and shades Gaussians in one kernel, which reads the inputs of colours only for Gaussians that are drawn."""

from __future__ import annotations

import torch
import triton
import triton.language as tl

from hyrfpack.ops.rasterize import Rasterization
from hyrfpack.ops.rasterize.gpu import bin_and_blend
from hyrfpack.ops.rasterize.gpu_project import (
    VIEWPOINT_OFFSET,
    Projection,
    flag_colors,
    flag_geometry,
    in_frustum,
    load_camera,
    load_rows_3,
    load_rows_4,
    pack_camera,
    project_block,
    store_colors,
    store_records,
)
from hyrfpack.ops.rasterize.inputs import Gaussians3D, RasterSettings
from hyrfpack.ops.shade import Shading
from hyrfpack.ops.shade.gpu import launch_size, shade_block
from hyrfpack.ops.viewport import Viewport


@triton.jit(do_not_specialize=["total", "width", "height"])
def project_shaded_kernel(
    means, quats, scales, opacities, first_layer, packed, b2, b3, color_logits, camera, total, width, height,
    records, keys, counts, visible, flags,
    IN: tl.constexpr, H1: tl.constexpr, H2: tl.constexpr, OUT: tl.constexpr,
    IN_P: tl.constexpr, H1_P: tl.constexpr, H2_P: tl.constexpr, OUT_P: tl.constexpr,
    FREQUENCY: tl.constexpr, PRECISION: tl.constexpr, ANTIALIASED: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Project the Gaussians in the frustum as `gpu_project.project` does, with colours from `shade_block`."""
    index = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = index < total
    mean, quat = load_rows_3(means, index, live), load_rows_4(quats, index, live)
    scale, opacity = load_rows_3(scales, index, live), tl.load(opacities + index, mask=live, other=0.0)
    loaded_camera = load_camera(camera)
    opacity_in_frustum = tl.where(in_frustum(mean, loaded_camera), opacity, 0.0)
    words, key, count = project_block(mean, quat, scale, opacity_in_frustum, loaded_camera, width, height, ANTIALIASED)
    drawn = count > 0
    # Records are stored before colours are computed, which takes all registers.
    store_records(records, index, drawn, words)
    flag_geometry(flags, mean, quat, scale, opacity)
    tl.store(keys + index, key, mask=live)
    tl.store(counts + index, count, mask=live)
    tl.store(visible + index, drawn.to(tl.uint8), mask=live)
    if tl.max(count, 0) > 0:
        viewpoint = (
            tl.load(camera + VIEWPOINT_OFFSET).to(tl.float32),
            tl.load(camera + VIEWPOINT_OFFSET + 1).to(tl.float32),
            tl.load(camera + VIEWPOINT_OFFSET + 2).to(tl.float32),
        )
        color = shade_block(
            mean, index, drawn, viewpoint, first_layer, packed, b2, b3, color_logits,
            IN, H1, H2, OUT, IN_P, H1_P, H2_P, OUT_P, FREQUENCY, PRECISION,
        )  # fmt: skip
        color = (tl.where(drawn, color[0], 0.0), tl.where(drawn, color[1], 0.0), tl.where(drawn, color[2], 0.0))
        store_colors(records, index, drawn, color, words[4])
        flag_colors(flags, color)


def rasterize_shaded(
    gaussians: Gaussians3D, shading: Shading, viewport: Viewport, settings: RasterSettings, cull_tolerance: float
) -> Rasterization:
    """Compute `hyrfpack.ops.rasterize.shaded.rasterize_shaded`."""
    total, device = len(gaussians.means), gaussians.means.device
    inputs = (tensor.detach().contiguous() for tensor in gaussians)
    camera = pack_camera(viewport, settings.near, device, cull_tolerance)
    tensors, constants = shading.kernel_arguments
    projection = Projection.empty(total, device)
    if total:
        block, warps = launch_size(shading.mixed)
        project_shaded_kernel[(triton.cdiv(total, block),)](
            *inputs, *tensors, camera, total, int(viewport.width), int(viewport.height),
            projection.records, projection.keys, projection.counts, projection.visible, projection.flags_and_ends,
            **constants, ANTIALIASED=bool(settings.antialiased), BLOCK=block, num_warps=warps, enable_fp_fusion=True,
        )  # fmt: skip
    image = bin_and_blend(projection, viewport, settings)
    pairs = image.pairs
    visible = projection.visible.view(torch.bool)
    return Rasterization(image.rgb, image.transmittance, image.depth, visible, len(pairs.owners), {}, pairs.nonfinite)

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
    load_gaussians,
    pack_camera,
    project_block,
    store_colors,
    store_counts,
    store_records,
)
from hyrfpack.ops.rasterize.inputs import Gaussians3D, RasterSettings
from hyrfpack.ops.shade import Shading
from hyrfpack.ops.shade.gpu import launch_size, shade_block
from hyrfpack.ops.viewport import Viewport


@triton.jit(do_not_specialize=["total", "width", "height"])
def project_shaded_kernel(
    gaussians, decoder, camera, total, width, height, projection,
    W: tl.constexpr, FREQUENCY: tl.constexpr, PRECISION: tl.constexpr, ANTIALIASED: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Project the Gaussians in the frustum as `gpu_project.project` does, with colours from `shade_block`."""
    index = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = index < total
    mean, quat, scale, opacity = load_gaussians(gaussians, index, live)
    loaded_camera = load_camera(camera)
    opacity_in_frustum = tl.where(in_frustum(mean, loaded_camera), opacity, 0.0)
    words, key, count = project_block(mean, quat, scale, opacity_in_frustum, loaded_camera, width, height, ANTIALIASED)
    drawn = count > 0
    # Records are stored before colours are computed, which takes all registers.
    store_records(projection.records, index, drawn, words)
    flag_geometry(projection.flags_and_ends, mean, quat, scale, opacity)
    store_counts(projection, index, live, key, count)
    if tl.max(count, 0) > 0:
        viewpoint = (
            tl.load(camera + VIEWPOINT_OFFSET).to(tl.float32),
            tl.load(camera + VIEWPOINT_OFFSET + 1).to(tl.float32),
            tl.load(camera + VIEWPOINT_OFFSET + 2).to(tl.float32),
        )
        color = shade_block(mean, index, drawn, viewpoint, decoder, W, FREQUENCY, PRECISION)
        color = (tl.where(drawn, color[0], 0.0), tl.where(drawn, color[1], 0.0), tl.where(drawn, color[2], 0.0))
        store_colors(projection.records, index, drawn, color, words[4])
        flag_colors(projection.flags_and_ends, color)


def rasterize_shaded(
    gaussians: Gaussians3D, shading: Shading, viewport: Viewport, settings: RasterSettings
) -> Rasterization:
    """Compute `hyrfpack.ops.rasterize.rasterize` with a `Shading`."""
    total, device = len(gaussians.means), gaussians.means.device
    inputs = Gaussians3D(*(tensor.detach().contiguous() for tensor in gaussians))
    camera = pack_camera(viewport, settings.near, device, settings.cull_tolerance, settings.low_pass_variance)
    decoder, constants = shading.kernel_arguments
    projection = Projection.empty(total, device)
    if total:
        block, warps = launch_size(shading.mixed)
        project_shaded_kernel[(triton.cdiv(total, block),)](
            inputs, decoder, camera, total, int(viewport.width), int(viewport.height), projection,
            **constants, ANTIALIASED=bool(settings.antialiased), BLOCK=block, num_warps=warps, enable_fp_fusion=True,
        )  # fmt: skip
    image = bin_and_blend(projection, viewport, settings)
    pairs = image.pairs
    visible = projection.visible.view(torch.bool)
    return Rasterization(image.rgb, image.transmittance, image.depth, visible, len(pairs.owners), {}, pairs.nonfinite)

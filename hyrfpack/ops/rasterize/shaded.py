"""Rasterises Gaussians whose colours are decoded during projection, for inference with a fixed model."""

from __future__ import annotations

import dataclasses
from time import perf_counter

import torch

from hyrfpack.ops.poses import camera_center
from hyrfpack.ops.rasterize import Rasterization, rasterize
from hyrfpack.ops.rasterize.cull import frustum_cull
from hyrfpack.ops.rasterize.inputs import Gaussians3D, RasterSettings, check_shapes
from hyrfpack.ops.shade import Shading, check_shading, choose_shading_implementation, shade
from hyrfpack.ops.viewport import Viewport


@torch.no_grad()
def rasterize_shaded(
    gaussians: Gaussians3D,
    shading: Shading,
    viewport: Viewport,
    settings: RasterSettings,
    implementation: str,
) -> Rasterization:
    """Compute `hyrfpack.ops.rasterize.rasterize` with a `Shading`."""
    check_shapes(gaussians)
    means = gaussians.means
    check_shading(shading, len(means))
    if choose_shading_implementation("rasterize_shaded", shading, implementation, *gaussians) == "gpu":
        from hyrfpack.ops.rasterize import gpu_shaded

        return gpu_shaded.rasterize_shaded(gaussians, shading, viewport, settings)
    started = perf_counter()
    index = frustum_cull(means, viewport, settings.near, settings.cull_tolerance)
    culled = perf_counter()
    drawn = gaussians.select(index)
    colors = shade(means, camera_center(viewport.pose.to(means)), shading, index)
    seconds = {"cull": culled - started, "decode": perf_counter() - culled}
    image = rasterize(drawn, colors, viewport, settings)
    visible = torch.zeros(len(means), dtype=torch.bool, device=means.device)
    visible[index] = image.visible
    return dataclasses.replace(image, visible=visible, seconds=seconds | image.seconds)

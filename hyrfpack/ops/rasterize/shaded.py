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
    settings: RasterSettings = RasterSettings(),  # noqa: B008 - frozen
    *,
    cull_tolerance: float = 0.3,
    implementation: str = "auto",
) -> Rasterization:
    """Render the Gaussians whose centres a camera sees, with their view-dependent colours.

    The result equals that of `frustum_cull`, `shade` from the camera's centre and `rasterize`. "gpu" runs all steps
    before binning in one kernel, which decodes a colour while it projects, and only for a Gaussian that is drawn.

    Args:
        gaussians: N Gaussians.
        shading: the colour decoder of these N Gaussians.
        viewport, settings: as in `rasterize`.
        cull_tolerance: how far outside the image a centre may project, as a fraction of half the image's size.
        implementation: "auto", "reference" or "gpu"; "reference" runs each step in its fastest implementation.

    Returns:
        The image, not differentiable; its field `visible` is (N,), and `seconds` also has the stages cull and decode.

    Raises:
        FloatingPointError: a centre is NaN or infinite ("reference"; "gpu" reports it as `nonfinite`).
        ValueError, MemoryError: as `rasterize` and `shade`.
    """
    check_shapes(gaussians)
    means = gaussians.means
    check_shading(shading, len(means))
    if choose_shading_implementation(shading, implementation, *gaussians) == "gpu":
        from hyrfpack.ops.rasterize import gpu_shaded

        return gpu_shaded.rasterize_shaded(gaussians, shading, viewport, settings, cull_tolerance)
    started = perf_counter()
    index = frustum_cull(means, viewport, settings.near, cull_tolerance)
    culled = perf_counter()
    drawn = gaussians.select(index)
    colors = shade(means, camera_center(viewport.pose.to(means)), shading, index)
    seconds = {"cull": culled - started, "decode": perf_counter() - culled}
    image = rasterize(drawn, colors, viewport, settings)
    visible = torch.zeros(len(means), dtype=torch.bool, device=means.device)
    visible[index] = image.visible
    return dataclasses.replace(image, visible=visible, seconds=seconds | image.seconds)

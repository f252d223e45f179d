"""Rasterises Gaussians whose colours are decoded during projection, for inference with a fixed model."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from hyrfpack.ops.poses import camera_center
from hyrfpack.ops.rasterize import Rasterization, check_inputs, rasterize
from hyrfpack.ops.rasterize.cull import frustum_cull
from hyrfpack.ops.rasterize.reference import TRANSMITTANCE_MIN
from hyrfpack.ops.shade import Shading, check_shading, choose_shading_implementation, shade


@torch.no_grad()
def rasterize_shaded(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    shading: Shading,
    camera_from_world: Tensor,
    intrinsics: tuple[float, float, float, float],
    width: int,
    height: int,
    *,
    near: float = 0.01,
    cull_tolerance: float = 0.3,
    antialiased: bool = False,
    transmittance_min: float = TRANSMITTANCE_MIN,
    depth: bool = False,
    implementation: str = "auto",
) -> Rasterization:
    """Render the Gaussians whose centres a camera sees, with their view-dependent colours.

    The result equals that of `frustum_cull`, `shade` from the camera's centre and `rasterize`. "gpu" runs all steps
    before binning in one kernel, which decodes a colour while it projects, and only for a Gaussian that is drawn.

    Args:
        means, quats, scales, opacities: (N, 3), (N, 4), (N, 3), (N,) as in `rasterize`, of all Gaussians.
        shading: the colour decoder of these N Gaussians.
        camera_from_world: (4, 4), preferably on the CPU.
        intrinsics, width, height, near, antialiased, transmittance_min, depth: as in `rasterize`.
        cull_tolerance: how far outside the image a centre may project, as a fraction of half the image's size.
        implementation: "auto", "reference" or "gpu"; "reference" runs each step in its fastest implementation.

    Returns:
        The image, not differentiable; its field `visible` is (N,).

    Raises:
        ValueError, MemoryError: as `rasterize` and `shade`.
    """
    geometry = {"means": means, "quats": quats, "scales": scales, "opacities": opacities}
    check_inputs(geometry, camera_from_world, width, height, near, transmittance_min)
    check_shading(shading, len(means))
    if choose_shading_implementation(shading, implementation, *geometry.values()) == "gpu":
        from hyrfpack.ops.rasterize.gpu_shaded import rasterize_shaded as run

        return run(
            means,
            quats,
            scales,
            opacities,
            shading,
            camera_from_world,
            intrinsics,
            width,
            height,
            near=near,
            cull_tolerance=cull_tolerance,
            antialiased=antialiased,
            transmittance_min=transmittance_min,
            depth=depth,
        )
    pose = camera_from_world.to(means)
    index = frustum_cull(means, pose, intrinsics, width, height, near, cull_tolerance)
    colors = shade(means, camera_center(pose), shading, index)
    image = rasterize(
        means[index],
        quats[index],
        scales[index],
        opacities[index],
        colors,
        camera_from_world,
        intrinsics,
        width,
        height,
        near=near,
        antialiased=antialiased,
        transmittance_min=transmittance_min,
        depth=depth,
    )
    visible = torch.zeros(len(means), dtype=torch.bool, device=means.device)
    visible[index] = image.visible
    return dataclasses.replace(image, visible=visible)

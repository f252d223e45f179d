"""Rasterising with colours that are made on the way: what inference does with a model that does not change."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from hyrfpack.ops.poses import camera_center
from hyrfpack.ops.rasterize import Rasterization, check, rasterize
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
    """Draw the Gaussians whose centres a camera sees, in the colours they have from there.

    As `frustum_cull`, then `shade` from the camera's place, then `rasterize`, with one kernel for what goes before
    binning: a colour is decoded while its Gaussian is projected, and only where it is drawn.

    Args:
        means, quats, scales, opacities: (N, 3), (N, 4), (N, 3), (N,) as in `rasterize`, of all Gaussians.
        shading: of these N.
        camera_from_world: (4, 4), best on the CPU.
        intrinsics, width, height, near, antialiased, transmittance_min, depth: as in `rasterize`.
        cull_tolerance: how far outside the picture a centre may project, as a fraction of half its size.
        implementation: "auto", "reference" or "gpu"; "reference" takes the best there is for each part.

    Returns:
        The picture; `visible` is (N,). Not differentiable.

    Raises:
        ValueError, MemoryError: as `rasterize` and `shade`.
    """
    geometry = {"means": means, "quats": quats, "scales": scales, "opacities": opacities}
    check(geometry, camera_from_world, width, height, near, transmittance_min)
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
    drawn = rasterize(
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
    visible[index] = drawn.visible
    return dataclasses.replace(drawn, visible=visible)

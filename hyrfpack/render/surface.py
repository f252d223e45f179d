"""Renders the surface of a view: its median depth and its normals."""

from __future__ import annotations

import torch
from torch import Tensor

from hyrfpack.model import Decoded, Frame, HybridModel
from hyrfpack.model.merged import MergedModel
from hyrfpack.ops.rasterize import Gaussians3D, RasterSettings, rasterize
from hyrfpack.ops.rasterize.median_depth import median_depth
from hyrfpack.ops.rasterize.reference import quats_to_rotations
from hyrfpack.parallel.pool import torch_on_one_thread
from hyrfpack.render.depth_normals import normals_from_depth, unit_rays
from hyrfpack.render.parts import camera_frame, gather_geometry
from hyrfpack.render.renderer import RenderSettings, make_raster_settings
from hyrfpack.render.sampling import widen_to_photos
from hyrfpack.scene import Camera

# Weight of the normals from depth, beside the blended axes of Gaussians, whose length is at most 1. Of 0.1 to 0.5, it
# has the lowest mean error (docs/research/mesh.md).
DEPTH_NORMAL_WEIGHT = 0.5


@torch_on_one_thread()
@torch.no_grad()
def render_median_depth(
    model: HybridModel | MergedModel, camera: Camera, decoded: Decoded, index: Tensor, settings: RenderSettings
) -> Tensor:
    """Render the depth along the view axis at which half of the light is lost, (H, W) in world units on the CPU.

    It is 0 where Gaussians hold back less than half of the light; see `hyrfpack.ops.rasterize.median_depth`.

    Args:
        model: the model to render.
        camera: the camera, in world units.
        decoded: result of `model.decode()`.
        index: (n,) int64, the Gaussians to draw, such as those that `render_view` found to be visible.
        settings: render settings.
    """
    gaussians, frame = drawn_gaussians(model, camera, decoded, index)
    return _median_depth_in_frame(gaussians, frame, camera, make_raster_settings(model, settings))


def drawn_gaussians(
    model: HybridModel | MergedModel, camera: Camera, decoded: Decoded, index: Tensor
) -> tuple[Gaussians3D, Frame]:
    """Return Gaussians as `render_view` draws them, sampled no more finely than the photos did, and their frame."""
    if isinstance(model, MergedModel):
        return gather_geometry(model, camera, index, decoded), camera_frame(model, camera)
    gaussians, frame = decoded.geometry[index].with_means(model.gaussians.positions[index]), model.config.frame
    if (sizes := model.gaussians.pixel_sizes) is None:
        return gaussians, frame
    viewport = frame.local_viewport(camera, gaussians.means.dtype)
    return widen_to_photos(gaussians, sizes[index], viewport, antialiased=model.config.antialiased), frame


@torch_on_one_thread()
@torch.no_grad()
def render_surface(
    gaussians: Gaussians3D, frame: Frame, camera: Camera, settings: RasterSettings, *, normals: bool
) -> tuple[Tensor, Tensor | None]:
    """Render the median depth (H, W) and, if wanted, the normals (H, W, 3) of Gaussians in the local units of a frame.

    Both are on the CPU and in world units and axes; see `render_median_depth` and `render_normals`.

    Args:
        settings: those with which the Gaussians are rasterised.
    """
    depth = _median_depth_in_frame(gaussians, frame, camera, settings)
    return depth, render_normals(gaussians, depth, frame, camera, settings) if normals else None


def _median_depth_in_frame(gaussians: Gaussians3D, frame: Frame, camera: Camera, settings: RasterSettings) -> Tensor:
    on_cpu = Gaussians3D(*(tensor.detach().cpu() for tensor in gaussians))
    viewport = frame.local_viewport(camera, on_cpu.means.dtype)
    return frame.scale * median_depth(on_cpu, viewport, settings)


@torch_on_one_thread()
@torch.no_grad()
def render_normals(
    gaussians: Gaussians3D,
    depth: Tensor,
    frame: Frame,
    camera: Camera,
    settings: RasterSettings,
    *,
    depth_weight: float = DEPTH_NORMAL_WEIGHT,
) -> Tensor:
    """Render the unit normals of the surface, (H, W, 3) in world axes, on the CPU.

    They face the camera, and are (0, 0, 0) where there is no depth. The shortest axes of Gaussians are blended like
    colours, each weighted by how flat the Gaussian is: w = (1 - s_1 / s_2)^2, with the shortest and the middle axis.
    The normals that depth shows (`normals_from_depth`) are added, because the axes of round Gaussians say nothing.

    Args:
        gaussians: Gaussians in the local units of the frame.
        depth: (H, W) median depth in world units, 0 where there is no surface.
        frame: the frame.
        camera: the camera, in world units.
        settings: those with which the Gaussians are rasterised.
        depth_weight: weight of the normals from depth.
    """
    viewport = frame.local_viewport(camera, gaussians.means.dtype)
    pose = viewport.pose.to(gaussians.means)
    scales, order = gaussians.scales.sort(dim=-1)
    axes = pose[:3, :3] @ quats_to_rotations(gaussians.quats)
    shortest = axes.gather(2, order[:, None, :1].expand(-1, 3, -1))[..., 0]
    positions = gaussians.means @ pose[:3, :3].T + pose[:3, 3]
    faces_away = (shortest * positions).sum(dim=-1, keepdim=True) > 0
    flatness = 1 - scales[:, :1] / scales[:, 1:2].clamp_min(torch.finfo(scales.dtype).tiny)
    weighted = torch.where(faces_away, -shortest, shortest) * flatness.square()
    blended = rasterize(gaussians, weighted, viewport, settings).rgb.cpu().double()
    depth = depth.cpu().double()
    normals = blended + depth_weight * normals_from_depth(depth, camera)
    faces_away = (normals * unit_rays(camera)).sum(dim=-1, keepdim=True) > 0
    normals = torch.nn.functional.normalize(torch.where(faces_away, -normals, normals), dim=-1)
    in_world = normals @ torch.from_numpy(camera.rotation)
    return torch.where(depth[..., None] > 0, in_world, 0).float()

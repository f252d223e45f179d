"""Brings the Gaussians of several models that a camera sees into the axes of that camera."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from hyrfpack.model import Decoded, Frame, HybridModel
from hyrfpack.model.exposure import apply_exposure_gains, clamp_colors
from hyrfpack.model.merged import MergedModel
from hyrfpack.ops.poses import camera_center
from hyrfpack.ops.rasterize import Gaussians3D, RasterSettings, rasterize
from hyrfpack.ops.rasterize.cull import frustum_cull
from hyrfpack.ops.rows import take_rows
from hyrfpack.ops.transfer import tensor_like
from hyrfpack.ops.viewport import Viewport
from hyrfpack.render.sampling import widen_to_photos
from hyrfpack.rotations import multiply_quats, quaternion_from_matrix
from hyrfpack.scene import Camera


def gather_parts(
    model: MergedModel,
    camera: Camera,
    near: float,
    cull_tolerance: float,
    decoded: Decoded | None = None,
) -> tuple[Tensor, Gaussians3D, Tensor]:
    """Return the Gaussians of all parts in view of a camera, in the local units of `camera_frame`.

    Args:
        model: the merged model.
        camera: the camera, in world units.
        near, cull_tolerance: as in `RenderSettings`; `near` is in local units of each part.
        decoded: result of `model.decode()`, or None.

    Returns:
        Indices (n,) int64 of the Gaussians, counted over all parts in their order; the Gaussians; colours (n, 3).

    Raises:
        FloatingPointError: a position is NaN or infinite.
    """
    indices, colors, first = [], [], 0
    for part in model.parts:
        viewport = part.config.frame.local_viewport(camera, part.gaussians.positions.dtype)
        index = frustum_cull(part.gaussians.positions, viewport, near, cull_tolerance)
        indices.append(index + first)
        colors.append(part.decode_colors(camera_center(viewport.pose).to(part.gaussians.positions), index))
        first += len(part)
    drawn = torch.cat(indices)
    return drawn, gather_geometry(model, camera, drawn, decoded), torch.cat(colors)


def nearest_plane(model: MergedModel, near: float) -> float:
    """Return the near plane of the part with the smallest unit, in the local units of `camera_frame`.

    `gather_parts` culls each part at its own near plane; of what it returns, nothing is nearer than this one.

    Args:
        model: the merged model.
        near: the near plane in local units of each part.
    """
    return near * min(part.config.frame.scale for part in model.parts) / model.scene.config.frame.scale


def gather_geometry(model: MergedModel, camera: Camera, index: Tensor, decoded: Decoded | None = None) -> Gaussians3D:
    """Return Gaussians of all parts as a camera draws them, in the local units of `camera_frame`.

    Args:
        model: the merged model.
        camera: the camera, in world units.
        index: (n,) int64 ascending, the Gaussians, counted over all parts in their order.
        decoded: result of `model.decode()`, or None.
    """
    frame, first, gaussians = camera_frame(model, camera), 0, []
    for part in model.parts:
        merged_index = index[(index >= first) & (index < first + len(part))]
        part_index = merged_index - first
        geometry = part.decode_geometry(part_index) if decoded is None else decoded.geometry[merged_index]
        local = geometry.with_means(take_rows(part.gaussians.positions, part_index))
        if (sizes := part.gaussians.pixel_sizes) is not None:
            viewport = part.config.frame.local_viewport(camera, part.gaussians.positions.dtype)
            local = widen_to_photos(local, sizes[part_index], viewport, antialiased=part.config.antialiased)
        gaussians.append(_to_frame(local, part.config.frame, frame))
        first += len(part)
    return Gaussians3D(*(torch.cat(values) for values in zip(*gaussians, strict=True)))


def expose_parts(
    model: MergedModel,
    camera: Camera,
    rgb: Tensor,
    index: Tensor,
    gaussians: Gaussians3D,
    viewport: Viewport,
    settings: RasterSettings,
) -> Tensor:
    """Bring a render of a merged model to the exposures that the maps of its parts predict for a camera.

    Log gains are blended as colours are: the log gain of a pixel is the mean over the Gaussians that it shows, weighted
    by their light. So a pixel that shows one part has the exposure of that part.

    Args:
        model: the merged model.
        camera: the camera, in world units.
        rgb: (H, W, 3), at the consistent exposure of each part. Colours above 1 become 1, as in `apply_exposure_map`.
        index, gaussians: results of `gather_parts`.
        viewport: the camera, in the local units of `camera_frame`.
        settings: settings that `rgb` was rasterised with.

    Returns:
        (H, W, 3) in [0, 1].
    """
    if all(part.exposure is None for part in model.parts):
        return rgb
    log_gains = torch.stack([tensor_like(_predict_log_gains(part, camera), rgb) for part in model.parts])
    ends = torch.tensor([len(part) for part in model.parts], device=index.device).cumsum(0)
    blended = rasterize(gaussians, log_gains[torch.bucketize(index, ends, right=True)], viewport, settings)
    behind = blended.transmittance[..., None] * log_gains[0]
    return apply_exposure_gains(clamp_colors(rgb), (blended.rgb + behind).exp())


def _predict_log_gains(model: HybridModel, camera: Camera) -> list[float]:
    """Return the log gains (3,) that a model's exposure map predicts for a camera; zeros without a map."""
    if model.exposure is None:
        return [0.0, 0.0, 0.0]
    return np.log(model.exposure.predict_gains(model.config.frame.local_pose(camera))).tolist()


def camera_frame(model: MergedModel, camera: Camera) -> Frame:
    """Return the frame of `gather_parts`: the axes and the position of a camera, and the unit of the first part."""
    x, y, z = camera.position.tolist()
    w, i, j, k = quaternion_from_matrix(camera.rotation.T).tolist()
    return Frame((x, y, z), model.scene.config.frame.scale, (1.0, 1.0, 1.0), (w, i, j, k))


def _to_frame(gaussians: Gaussians3D, source: Frame, target: Frame) -> Gaussians3D:
    """Return Gaussians, given in local units of the frame `source`, in local units and axes of the frame `target`."""
    turn = target.axes.T @ source.axes
    factor, offset = source.scale / target.scale, target.to_local(np.array([source.center]))[0]
    rotation = tensor_like((factor * turn).tolist(), gaussians.means)
    turned_basis = multiply_quats(quaternion_from_matrix(turn), np.eye(4))
    return Gaussians3D(
        gaussians.means @ rotation.T + tensor_like(offset.tolist(), gaussians.means),
        gaussians.quats @ tensor_like(turned_basis.tolist(), gaussians.quats),
        factor * gaussians.scales,
        gaussians.opacities,
    )

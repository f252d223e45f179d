"""Measures the errors of levels of detail in pictures, for each chunk and several sizes of its projection."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from hyrfpack.lod.select import project_sphere
from hyrfpack.model import Decoded, HybridModel
from hyrfpack.ops.rasterize import rasterize
from hyrfpack.progress import Progress, TaskEvent, ignore_progress
from hyrfpack.render import RenderSettings, render_view
from hyrfpack.scene import Camera

ERROR_RADII = (16.0, 32.0, 64.0, 128.0, 256.0, 512.0, 1024.0)
# Views are measured at these shares of the photos' resolution. A coarser picture is the view from farther away.
RESOLUTION_SHARES = (1.0, 1 / 2, 1 / 4, 1 / 8)
_COLUMNS = 3  # shares of chunks that are drawn at once, as the three channels of a picture


@torch.no_grad()
def measure_level_errors(
    models: Sequence[HybridModel],
    chunk_of: np.ndarray,
    spheres: Sequence[tuple[tuple[float, float, float], float]],
    cameras: Sequence[Camera],
    progress: Progress = ignore_progress,
) -> np.ndarray:
    """Measure the error of each level and chunk, in pixels that show the chunk.

    A level is drawn for all chunks at once. The squared error of a pixel is divided among the chunks by their light in
    the render of the finest level. So the errors of all chunks add up to that of the picture.

    Args:
        models: the model at each level, the finest first.
        chunk_of: (N,) chunk of each Gaussian of the finest level.
        spheres: centre and radius of each chunk, world units.
        cameras: views to measure at, world units.
        progress: called with `TaskEvent`s.

    Returns:
        (levels, chunks, len(ERROR_RADII)) float64: mean squared errors, relative to the area that `project_sphere`
        gives; 0 for the finest level.
    """
    shape = (len(models), len(spheres), len(ERROR_RADII))
    sums, areas = np.zeros(shape), np.zeros(shape[1:])
    decoded = [model.decode() for model in models]
    views = [resize_camera(camera, share) for camera in cameras for share in RESOLUTION_SHARES]
    for number, camera in enumerate(views):
        progress(TaskEvent(f"measuring levels, view {number + 1}/{len(views)}", number / len(views)))
        finest = render_view(models[0], camera, decoded=decoded[0]).rgb
        differences = [
            (render_view(model, camera, decoded=each).rgb - finest).square().mean(dim=-1)
            for model, each in zip(models[1:], decoded[1:], strict=True)
        ]
        projections = [project_sphere(center, radius, camera) for center, radius in spheres]
        shown = [chunk for chunk, (_, area) in enumerate(projections) if area > 0]
        for first in range(0, len(shown), _COLUMNS):
            some = shown[first : first + _COLUMNS]
            shares = _draw_shares(models[0], decoded[0], chunk_of, some, camera)
            for column, chunk in enumerate(some):
                radius, area = projections[chunk]
                weights = _node_weights(radius)
                areas[chunk] += weights * area
                for level, difference in enumerate(differences, 1):
                    sums[level, chunk] += weights * float((difference * shares[..., column]).sum())
    return _fill_gaps(sums, areas)


def resize_camera(camera: Camera, share: float) -> Camera:
    """Return a camera whose picture has a share of the pixels of each axis; the view stays about the same."""
    width, height = (max(1, round(share * side)) for side in (camera.width, camera.height))
    x, y = width / camera.width, height / camera.height
    return Camera(width, height, x * camera.fx, y * camera.fy, x * camera.cx, y * camera.cy, camera.camera_from_world)


def _draw_shares(
    model: HybridModel, decoded: Decoded, chunk_of: np.ndarray, chunks: Sequence[int], camera: Camera
) -> Tensor:
    """Return the share (H, W, 3) of each pixel's light that comes from each of up to three chunks."""
    gaussians = decoded.geometry.at(model.gaussians.positions)
    members = np.stack([chunk_of == chunk for chunk in (*chunks, -1, -1)[:_COLUMNS]], axis=1)
    colors = torch.from_numpy(members).to(gaussians.means)
    viewport = model.config.frame.local_viewport(camera, gaussians.means.dtype)
    return rasterize(gaussians, colors, viewport, RenderSettings().raster_settings(model.config.antialiased)).rgb


def _node_weights(radius: float) -> np.ndarray:
    """Return the weights (K,) of ERROR_RADII in the linear interpolation in the logarithm of the radius."""
    weights = np.zeros(len(ERROR_RADII))
    place = np.interp(np.log(max(radius, 1e-30)), np.log(ERROR_RADII), np.arange(len(ERROR_RADII)))
    low = min(int(place), len(ERROR_RADII) - 2)
    weights[low], weights[low + 1] = low + 1 - place, place - low
    return weights


def _fill_gaps(sums: np.ndarray, areas: np.ndarray) -> np.ndarray:
    """Divide sums by areas; radii that no view shows take the error of the nearest one that a view does."""
    errors = np.zeros_like(sums)
    for chunk, area in enumerate(areas):
        measured = np.flatnonzero(area > 0)
        if len(measured):
            nearest = measured[np.abs(np.arange(len(area))[:, None] - measured).argmin(axis=1)]
            errors[:, chunk] = sums[:, chunk, nearest] / area[nearest]
    return errors

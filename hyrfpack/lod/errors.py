"""Measure the errors of levels of detail in pictures, for each chunk and several sizes of its projection."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from hyrfpack.cameras.view_sampling import resize_camera
from hyrfpack.format.scene_model import join_parts
from hyrfpack.lod.select import MIN_LEFT_OUT_MSE, project_sphere
from hyrfpack.model import Decoded, HybridModel
from hyrfpack.model.merged import MergedModel
from hyrfpack.ops.rasterize import Gaussians3D, RasterSettings, rasterize
from hyrfpack.ops.rasterize.light import measure_light
from hyrfpack.ops.viewport import Viewport
from hyrfpack.progress import Progress, TaskEvent, ignore_progress
from hyrfpack.render import RenderSettings, render_view
from hyrfpack.render.renderer import make_raster_settings
from hyrfpack.render.surface import drawn_gaussians
from hyrfpack.scene import Camera

ERROR_RADII = (16.0, 32.0, 64.0, 128.0, 256.0, 512.0, 1024.0)
# Views are rendered at these ratios of the resolution of photos: the first at those of the first group, the second at
# those of the second, and so on in turn. A coarser picture stands for a view from farther away. Two resolutions of
# twice as many views predict other views better than four resolutions of each view.
RESOLUTION_RATIOS = ((1.0, 1 / 4), (1 / 2, 1 / 8))
# This is added to the share of a pixel's light that comes from the drawn half of the chunks. So a pixel to which the
# half contributes little counts little, because its error comes from other chunks.
LIGHT_SHARE_OFFSET = 1e-3
# If the light of a chunk in all views, at a radius, adds up to less than this, its errors are those of its neighbours.
MIN_LIGHT_PIXELS = 1.0


@torch.no_grad()
def measure_level_errors(
    levels: Sequence[Sequence[HybridModel]],
    spheres: Sequence[tuple[tuple[float, float, float], float]],
    cameras: Sequence[Camera],
    fields: Sequence[HybridModel] | None = None,
    parts: Sequence[int] | None = None,
    seed: int = 0,
    progress: Progress = ignore_progress,
) -> np.ndarray:
    """Measure the error of each level and chunk, in pixels that show the chunk.

    In each view a random half of the chunks is drawn at a level, and the other half at the finest one; then the halves
    change places. So chunks are measured among neighbours of other levels, as views with a budget mix them. The squared
    error of a pixel is divided among the chunks of the half by their light in the render of the finest levels. A chunk
    that no view shows has the errors of all measured chunks together.

    Args:
        levels: models of all chunks at each level, the finest first. Those of a part share their fields.
        spheres: centre and radius of each chunk, world units.
        cameras: views to measure at, world units.
        fields: for each part of the scene, a model with its fields; None for those of the first chunk. All parts are
            drawn together.
        parts: number of the part of each chunk; None if there is one part.
        seed: random seed of the halves.
        progress: called with `TaskEvent`s.

    Returns:
        (levels, chunks, len(ERROR_RADII)) float64: mean squared errors, relative to the area that `project_sphere`
        gives; 0 for the finest level.
    """
    pool = _PooledChunks.of(levels, fields or levels[0][:1], parts or [0] * len(spheres))
    shape, rng = (len(levels), len(spheres), len(ERROR_RADII)), np.random.default_rng(seed)
    sums, areas, lights = np.zeros(shape), np.zeros(shape[1:]), np.zeros(shape[1:])
    turns = zip(cameras, itertools.cycle(RESOLUTION_RATIOS))
    views = [resize_camera(camera, ratio) for camera, ratios in turns for ratio in ratios]
    for number, camera in enumerate(views):
        progress(TaskEvent(f"measuring levels, view {number + 1}/{len(views)}", number / len(views)))
        in_half = rng.permutation(len(spheres)) % 2 == 0
        halves = in_half, ~in_half
        view, finest = pool.open_view(camera), pool.draw(np.zeros(len(spheres), np.int64), camera)
        # For each half and level, the error of each pixel divided by the half's share of its light.
        errors = []
        for half, light_share in zip(halves, view.draw_shares(halves).unbind(dim=-1), strict=True):
            renders = [pool.draw(half * level, camera) for level in range(1, len(levels))]
            errors += [(rgb - finest).square().mean(dim=-1) / (light_share + LIGHT_SHARE_OFFSET) for rgb in renders]
        light = view.measure_chunk_light(torch.stack([torch.ones_like(finest[..., 0]), *errors]), len(spheres))
        first, second = light[1:].reshape(2, len(levels) - 1, len(spheres))
        own_errors = np.where(in_half, first, second)
        for chunk, (center, world_radius) in enumerate(spheres):
            radius, area = project_sphere(center, world_radius, camera)
            if area > 0:
                weights = _node_weights(radius)
                areas[chunk] += weights * area
                lights[chunk] += weights * light[0, chunk]
                sums[1:, chunk] += weights * own_errors[:, chunk, None]
    # The sphere of a chunk may cover a picture that shows no Gaussian of it, such as one beside or behind the camera.
    is_visible = lights >= MIN_LIGHT_PIXELS
    return _fill_gaps(sums * is_visible, areas * is_visible)


@dataclass(frozen=True)
class _PooledChunks:
    """The Gaussians of all chunks at all levels.

    Attributes:
        model: one model of all N Gaussians.
        decoded: the view-independent part of the model.
        chunk_of, level_of: (N,) chunk and level of each Gaussian.
    """

    model: HybridModel | MergedModel
    decoded: Decoded
    chunk_of: np.ndarray
    level_of: np.ndarray

    @classmethod
    def of(
        cls, levels: Sequence[Sequence[HybridModel]], fields: Sequence[HybridModel], parts: Sequence[int]
    ) -> _PooledChunks:
        """Pool the models of all chunks at each level, part by part."""
        keys = [(level, chunk) for level in range(len(levels)) for chunk in range(len(parts))]
        keys.sort(key=lambda key: parts[key[1]])  # stable, so that the order within a part stays
        models = [levels[level][chunk] for level, chunk in keys]
        names = [str(number) for number in range(len(fields))]
        model = join_parts(names, fields, models, [parts[chunk] for _, chunk in keys])
        level_of, chunk_of = np.repeat(np.array(keys).T, list(map(len, models)), axis=1)
        return cls(model, model.decode(), chunk_of, level_of)

    def draw(self, levels: np.ndarray, camera: Camera) -> Tensor:
        """Render a view with a level (chunks,) of each chunk."""
        index = torch.from_numpy(np.flatnonzero(self.level_of == levels[self.chunk_of]))
        return render_view(self.model.subset(index), camera, decoded=self.decoded[index]).rgb

    def open_view(self, camera: Camera) -> _FinestView:
        """Return the finest levels of all chunks as a camera sees them."""
        index, model = torch.from_numpy(np.flatnonzero(self.level_of == 0)), self.model
        gaussians, frame = drawn_gaussians(model, camera, self.decoded, index)
        viewport = frame.local_viewport(camera, gaussians.means.dtype)
        settings = make_raster_settings(model, RenderSettings())
        return _FinestView(gaussians, self.chunk_of[self.level_of == 0], viewport, settings)


@dataclass(frozen=True)
class _FinestView:
    """The finest levels of all chunks in a view.

    Attributes:
        gaussians: the N Gaussians, in the units of the viewport.
        chunk_of: (N,) chunk of each Gaussian.
        viewport: the camera.
        settings: settings of the rasteriser.
    """

    gaussians: Gaussians3D
    chunk_of: np.ndarray
    viewport: Viewport
    settings: RasterSettings

    def draw_shares(self, halves: tuple[np.ndarray, np.ndarray]) -> Tensor:
        """Return the share (H, W, 2) of each pixel's light of two sets (chunks,) bool of chunks."""
        first, second = (half[self.chunk_of] for half in halves)
        colors = torch.from_numpy(np.stack((first, second, np.zeros_like(first)), axis=1)).to(self.gaussians.means)
        return rasterize(self.gaussians, colors, self.viewport, self.settings).rgb[..., :2]

    def measure_chunk_light(self, weights: Tensor, count: int) -> np.ndarray:
        """Return the light (k, count) float64 of each chunk, weighted by maps (k, H, W), see `measure_light`."""
        light = measure_light(self.gaussians, self.viewport, weights, self.settings).double().cpu().numpy()
        return np.stack([np.bincount(self.chunk_of, row, minlength=count) for row in light])


def _node_weights(radius: float) -> np.ndarray:
    """Return the weights (K,) of ERROR_RADII in the linear interpolation in the logarithm of the radius."""
    weights = np.zeros(len(ERROR_RADII))
    place = np.interp(np.log(max(radius, 1e-30)), np.log(ERROR_RADII), np.arange(len(ERROR_RADII)))
    low = min(int(place), len(ERROR_RADII) - 2)
    weights[low], weights[low + 1] = low + 1 - place, place - low
    return weights


def _fill_gaps(sums: np.ndarray, areas: np.ndarray) -> np.ndarray:
    """Divide sums (levels, chunks, K) of errors by areas (chunks, K), and estimate what no view shows.

    Radii that no view shows take the error of the nearest one that a view does. Chunks that no view shows take the
    errors of all measured chunks together, raised so that none falls towards coarser levels. If no view shows any
    chunk, coarse levels have the error MIN_LEFT_OUT_MSE.
    """
    typical = np.full((sums.shape[0], sums.shape[2]), MIN_LEFT_OUT_MSE)
    typical[0] = 0.0
    if areas.any():
        typical = np.maximum.accumulate(_mean_errors(sums.sum(axis=1), areas.sum(axis=0)), axis=0)
    chunks = [_mean_errors(sums[:, chunk], area) if area.any() else typical for chunk, area in enumerate(areas)]
    return np.stack(chunks, axis=1)


def _mean_errors(sums: np.ndarray, areas: np.ndarray) -> np.ndarray:
    """Divide sums (levels, K) by areas (K,), of which one is positive; K without an area take those of the nearest."""
    measured = np.flatnonzero(areas > 0)
    nearest = measured[np.abs(np.arange(len(areas))[:, None] - measured).argmin(axis=1)]
    return sums[:, nearest] / areas[nearest]

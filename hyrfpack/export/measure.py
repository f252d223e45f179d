"""Measurement of the loss of an export: pictures of splats against those of the model they were baked from."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean

import numpy as np
import torch
from torch import Tensor

from hyrfpack.evaluate.metrics import psnr, to_8bit
from hyrfpack.model import HybridModel
from hyrfpack.model.merged import MergedModel, scene_of
from hyrfpack.ops.background import pixel_directions
from hyrfpack.ops.viewport import Viewport
from hyrfpack.parallel.pool import parallel_map
from hyrfpack.progress import Progress, count_calls, ignore_progress
from hyrfpack.render import render_view
from hyrfpack.render.exposure import apply_exposure_map
from hyrfpack.scene import Camera, View
from hyrfpack.splats.draw import Drawable, draw
from hyrfpack.splats.splats import Splats

# Rounding that leaves a lower PSNR is reported: such pictures visibly differ.
MIN_ROUNDED_PSNR_DB = 30.0


@dataclass(frozen=True)
class PsnrScores:
    """PSNR of splats in dB, as means over views.

    Attributes:
        model: PSNR of the splats' pictures against the model's.
        photos: PSNR of the splats' pictures against the photos; None without photos.
        views: number of views.
    """

    model: float
    photos: float | None
    views: int


@torch.no_grad()
def measure_psnr(
    model: HybridModel | MergedModel,
    candidates: Mapping[str, tuple[Splats, np.ndarray | None]],
    views: Sequence[tuple[Camera, View | None]],
    *,
    sphere: bool,
    consistent: Collection[str] = (),
    progress: Progress = ignore_progress,
) -> dict[str, PsnrScores]:
    """Measure the PSNR of pictures of splats against those of a model, and against photos.

    Args:
        model: the model from which the splats were baked. It is scored, too, under the name "model".
        candidates: splats by name, each with its background: an equirectangular picture (H, 2H, 3) as
            `render_background_picture` makes it, or None for the model's solid colour, to which the exposure map is
            applied as in the model's pictures.
        views: cameras, with their photos or None. Photos are scored if all views have them.
        sphere: whether the model is rendered with its background sphere.
        consistent: names of the candidates of consistent exposure, behind which the solid colour is not exposed.
        progress: called with `TaskEvent`s.

    Returns:
        Scores by candidate, and those of the model as "model"; empty if the masks of the photos leave no pixel.
    """
    decoded, scene = model.decode(), scene_of(model)
    config, solid = scene.config, torch.tensor(scene.config.solid)
    drawables = {
        name: (Drawable.from_splats(splats, config.frame), panorama) for name, (splats, panorama) in candidates.items()
    }

    @torch.no_grad()  # because torch keeps this setting per thread
    def score_view(viewpoint: tuple[Camera, View | None]) -> dict[str, tuple[float, float | None]]:
        camera, view = viewpoint
        model_picture = to_8bit(render_view(model, camera, decoded=decoded, background=sphere).rgb)
        pictures = {"model": model_picture}
        exposed_solid = apply_exposure_map(scene, camera, solid)
        for name, (drawable, panorama) in drawables.items():
            raster = draw(drawable, camera)
            if panorama is None:
                backdrop = solid if name in consistent else exposed_solid
            else:
                backdrop = _sample_panorama(torch.from_numpy(panorama), camera)
            pictures[name] = to_8bit(raster.rgb + raster.transmittance[..., None] * backdrop)
        photo, mask = (None, None) if view is None else _load_photo(view, config.solid)
        if mask is not None and not mask.any():
            return {}
        return {
            name: (psnr(picture, model_picture, mask), None if photo is None else psnr(picture, photo, mask))
            for name, picture in pictures.items()
        }

    compare = count_calls(score_view, progress, "comparing renders with those of the model", len(views))
    scores = [view_scores for view_scores in parallel_map(compare, views) if view_scores]
    if not scores:
        return {}
    return {name: _average_scores([view_scores[name] for view_scores in scores]) for name in ("model", *drawables)}


def _sample_panorama(picture: Tensor, camera: Camera) -> Tensor:
    """Return an equirectangular picture as a camera sees it at infinite distance, (H, W, 3)."""
    height, width, _ = picture.shape
    rows, columns = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
    points = torch.stack((columns, rows), -1).reshape(-1, 2) + 0.5
    pose = torch.from_numpy(camera.camera_from_world)
    viewport = Viewport(pose, camera.intrinsics, camera.width, camera.height)
    directions = pixel_directions(points.double(), viewport)
    x, y, z = directions.float().unbind(-1)
    # The picture is extended by one column of the opposite side at each edge, so that interpolation wraps around.
    wrapped = torch.cat((picture[:, -1:], picture, picture[:, :1]), dim=1).permute(2, 0, 1)[None]
    across = torch.atan2(x, z) / torch.pi * width / (width + 2)
    down = 2 * torch.atan2(y, torch.hypot(x, z)) / torch.pi
    sample_points = torch.stack((across, down), -1)[None, None]
    sampled = torch.nn.functional.grid_sample(wrapped, sample_points, padding_mode="border", align_corners=False)
    return sampled[0, :, 0].T.reshape(camera.height, camera.width, 3)


def _load_photo(view: View, solid: tuple[float, float, float]) -> tuple[Tensor, Tensor | None]:
    picture = view.load()
    photo = torch.from_numpy(picture.composite(np.array(solid, np.float32)))
    return photo, None if picture.mask is None else torch.from_numpy(picture.mask)


def _average_scores(scores: Sequence[tuple[float, float | None]]) -> PsnrScores:
    model, photos = zip(*scores, strict=True)
    return PsnrScores(fmean(model), None if None in photos else fmean(photos), len(scores))


@torch.no_grad()
def measure_splats_psnr(reference: Drawable, candidate: Drawable, camera: Camera) -> float:
    """Measure the PSNR in dB of a camera's picture of `candidate` against that of `reference`, both over black."""
    picture, reference_picture = (to_8bit(draw(drawable, camera).rgb) for drawable in (candidate, reference))
    return psnr(picture, reference_picture)

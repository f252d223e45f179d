"""Set up an untrained model for a scene: preset, frame, sizes and initial Gaussians.

All sizes are chosen by the photos and the length of the run. Each choice is recorded with its reason, which
`hyrfpack info` shows.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from scipy.spatial import cKDTree

from hyrfpack.cameras.capture import quantized_provenance
from hyrfpack.config.train import FULL_STEPS, TrainConfig
from hyrfpack.data.cache import PictureCache
from hyrfpack.data.preset import detect_preset
from hyrfpack.errors import HyrfTrainingError
from hyrfpack.format.min_file_size import check_target_bytes
from hyrfpack.model import Frame, HashGridConfig, HybridModel, ModelConfig
from hyrfpack.model.gaussians import Gaussians, logit
from hyrfpack.model.hybrid import scale_bounds
from hyrfpack.scene import Scene
from hyrfpack.train.median_color import first_color, start_fields_at
from hyrfpack.train.provenance import training_provenance
from hyrfpack.train.silhouette import inside_silhouettes
from hyrfpack.train.surface_points import draw_surface_points

SYNTHETIC_HALF_BOX = 1.3  # NeRF-synthetic objects lie in [-1.3, 1.3]^3.
# The budget of a full-length run is the larger of two numbers, one by the pixels of one photo and one by those of all
# photos. For Mip-NeRF 360 at 1 megapixel they are 0.85 and 0.9 million; published models have up to 2.5 million.
GAUSSIANS_PER_PIXEL_OF_ONE_PHOTO = 0.85
GAUSSIANS_PER_PIXEL_OF_ALL_PHOTOS = 1 / 240
# This bounds the time of short runs on large photos. Runs of 2,000 steps reach it on photos of 830 x 550 pixels.
MAX_GAUSSIANS_PER_STEP = 50
MIN_BUDGET = 5_000
# A run on large photos has more Gaussians and takes fewer steps, because at equal time that scores higher on a CPU.
SMALL_PHOTO_PIXELS = 190_000
LARGE_PHOTO_PIXELS = 1_700_000
LARGE_PHOTO_STEPS = 2_000
# A packed file is assumed to take this many bytes for decoders and headers, and for each Gaussian with its table rows.
# By default `compress` takes 4 to 8 bytes per Gaussian. Of two files of equal size, the one with more Gaussians and
# coarser numbers scores higher, down to about 5 bytes.
PACKED_HEADER_BYTES = 8_000
PACKED_BYTES_PER_GAUSSIAN = 5.0
# In files smaller than this, decoders would take up to a third of the bytes. Narrow ones leave room for more Gaussians.
MIN_WIDE_TARGET_BYTES = 30_000
NARROW_WIDTH, PACKED_NARROW_HEADER_BYTES = 32, 5_000
MIN_TARGETED_BUDGET = 250
MAX_TARGETED_BUDGET_RATIO = 2  # The budget for a target size is at most this multiple of the usual one.
GAUSSIANS_PER_ROW = 20  # Applies to each level of the radiance grid. The paper's models have 8 to 20.
INITIAL_OPACITY = 0.1
# Initial scales are clamped to these multiples of the largest scale S(p).
MIN_INITIAL_SIZE, MAX_INITIAL_SIZE = 1e-5, 0.5
# Points with larger coordinates, in local units, are moved towards the box. That changes their direction, seen from the
# box, by at most 2e-4 radians.
MAX_INITIAL_COORDINATE = 1e4
# Cameras count as being in one place if their spread is a smaller share of their distance to the points.
MIN_CAMERA_SPREAD_RATIO = 1e-3
BACKGROUND_RGB = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0), "random": (0.0, 0.0, 0.0)}


def scene_frame(scene: Scene, preset: str) -> Frame:
    """Return the frame of a scene under a preset: the box B0, in the scene's own axes.

    The box of a NeRF-synthetic layout is +-1.3 around the origin. For "large" scenes, and other "synthetic" scenes,
    whose unit is not known, it spans the 1st to 99th percentile of the points. For all other scenes it is the box of
    the cameras. If all cameras are in one place, it also spans these percentiles.
    """
    if preset == "synthetic" and scene.layout == "blender":
        return Frame((0.0, 0.0, 0.0), SYNTHETIC_HALF_BOX, (1.0, 1.0, 1.0))
    positions = np.array([view.camera.position for view in scene.train])
    low, high = positions.min(0), positions.max(0)
    if len(scene.points):
        reach = float(np.median(np.linalg.norm(scene.points - positions.mean(0), axis=1)))
        if preset in ("large", "synthetic") or (high - low).max() <= MIN_CAMERA_SPREAD_RATIO * reach:
            low, high = np.percentile(scene.points, [1, 99], axis=0)
    # If the box has no extent (up to rounding), a box with half-axes of 1 in front of the first camera replaces it.
    if (high - low).max() <= 1e-9 * np.abs(positions).max():
        forward = scene.train[0].camera.forward
        low, high = positions[0] + forward - 1, positions[0] + forward + 1
    return Frame.from_box(low, high)


def budget_for(scene: Scene, config: TrainConfig, header_bytes: int | None = None) -> tuple[int, str]:
    """Return the Gaussian budget of a run and the reason in words.

    The usual budget (`usual_budget`) takes `config.budget_factor` into account. For a target size, the budget is the
    number of Gaussians that fit beside `header_bytes` of decoders and headers (None for those of one model), at most
    `MAX_TARGETED_BUDGET_RATIO` times the usual budget.
    """
    if config.max_gaussians is not None:
        return config.max_gaussians, "asked for"
    budget = usual_budget_for(scene, config.steps)
    pixels = f"{count_pixels(scene):,} pixels in all"
    why = f"{pixels}, {config.steps:,} steps"
    if config.target_bytes is not None:
        if header_bytes is None:
            header_bytes = PACKED_NARROW_HEADER_BYTES if has_narrow_decoders(config) else PACKED_HEADER_BYTES
        fitting = max(MIN_TARGETED_BUDGET, round((config.target_bytes - header_bytes) / PACKED_BYTES_PER_GAUSSIAN))
        if fitting <= MAX_TARGETED_BUDGET_RATIO * budget:
            return fitting, f"to be packed into {config.target_bytes:,} bytes"
        return MAX_TARGETED_BUDGET_RATIO * budget, f"{MAX_TARGETED_BUDGET_RATIO} times what suits {why}"
    if config.budget_factor in (None, 1):
        return budget, why
    corrected = usual_budget_for(scene, config.steps, config.budget_factor)
    if corrected == budget:
        return budget, f"the limit for {config.steps:,} steps, below {config.budget_factor:g} times what suits {pixels}"
    return corrected, f"{config.budget_factor:g} times what suits {why}"


def has_narrow_decoders(config: TrainConfig) -> bool:
    """Return whether decoders of half the usual width suit the target size."""
    return config.target_bytes is not None and config.target_bytes < MIN_WIDE_TARGET_BYTES


def check_has_photos(scene: Scene) -> None:
    """Raise HyrfTrainingError if a scene has no photos to train on."""
    if not scene.train:
        raise HyrfTrainingError(
            f"{scene.path}: no views are left for training",
            fix="use fewer test views (`test_every=0` trains on all)",
        )


def count_pixels(scene: Scene) -> int:
    """Return the number of pixels of all training photos."""
    return sum(view.camera.width * view.camera.height for view in scene.train)


def usual_budget_for(scene: Scene, steps: int, factor: float = 1.0) -> int:
    """Return the Gaussian budget that a scene's training photos and the length of a run suggest, see `usual_budget`."""
    pixels = count_pixels(scene)
    return usual_budget(pixels / len(scene.train), pixels, steps, factor)


def usual_budget(photo_pixels: float, all_pixels: float, steps: int, factor: float = 1.0) -> int:
    """Return the Gaussian budget that photos and the length of a run suggest.

    It grows with the photos' pixels and with the square root of the run's length, because a shorter run can fit fewer
    Gaussians. `MAX_GAUSSIANS_PER_STEP` limits the time of short runs on large photos.

    Args:
        photo_pixels: mean number of pixels of a training photo.
        all_pixels: number of pixels of all training photos.
        steps: number of optimiser steps.
        factor: multiplies what the pixels suggest. Above 1, it raises the limit by steps, too; below 1, it does not
            lower that limit, which may be far below what the scene is worth.
    """
    full = max(GAUSSIANS_PER_PIXEL_OF_ONE_PHOTO * photo_pixels, GAUSSIANS_PER_PIXEL_OF_ALL_PHOTOS * all_pixels)
    length = math.sqrt(min(1.0, steps / FULL_STEPS))
    suggested, limit = (max(MIN_BUDGET, count) for count in (round(full * length), MAX_GAUSSIANS_PER_STEP * steps))
    return max(1, min(round(factor * suggested), round(max(1.0, factor) * limit)))


def usual_steps(
    photo_pixels: float, small_photo_steps: int = TrainConfig.steps, large_photo_steps: int = LARGE_PHOTO_STEPS
) -> int:
    """Return the usual number of steps for photos of this size: a power law between small and large photos.

    It suits a CPU. On a GPU, longer runs are usual.

    Args:
        photo_pixels: mean number of pixels of a training photo.
        small_photo_steps: steps on photos of at most `SMALL_PHOTO_PIXELS`.
        large_photo_steps: steps on photos of `LARGE_PHOTO_PIXELS` or more.
    """
    exponent = math.log(photo_pixels / SMALL_PHOTO_PIXELS) / math.log(LARGE_PHOTO_PIXELS / SMALL_PHOTO_PIXELS)
    return round(small_photo_steps * (large_photo_steps / small_photo_steps) ** min(max(exponent, 0.0), 1.0))


def check_target(scene: Scene, config: TrainConfig) -> None:
    """Check that a packed model of these photos can be as small as the target size.

    A file contains some of the cameras, so its smallest possible size depends on the scene.

    Raises:
        HyrfError: the target size is below the smallest possible size.
    """
    if config.target_bytes is None or not scene.train:
        return
    preset = config.preset if config.preset != "auto" else detect_preset(scene)[0]
    provenance = {"steps": config.steps, "seed": config.seed, **training_provenance(scene)}
    check_target_bytes(
        config.target_bytes, quantized_provenance(provenance, scene_frame(scene, preset).scale, scene.points)
    )


def table_size_for(budget: int, config: TrainConfig) -> tuple[int, str]:
    """Return log2 of the radiance table's rows per level for a budget, and the reason in words."""
    if config.log2_table_size is not None:
        return config.log2_table_size, "asked for"
    log2 = round(math.log2(max(1, budget / GAUSSIANS_PER_ROW)))
    return min(21, max(8, log2)), f"{GAUSSIANS_PER_ROW} Gaussians for each row and level"


def build_model(
    scene: Scene, config: TrainConfig, cache: PictureCache | None = None
) -> tuple[HybridModel, int, dict[str, str]]:
    """Build an untrained model for a scene.

    Args:
        scene: the scene.
        config: settings of the run.
        cache: cache of decoded photos; None keeps none.

    Returns:
        The model, its Gaussian budget, and a text with the choice and its reason for each setting.

    Raises:
        HyrfTrainingError: the scene has no training views.
        HyrfDataError: a photo cannot be read.
    """
    check_has_photos(scene)
    preset, why_preset = (config.preset, "asked for") if config.preset != "auto" else detect_preset(scene)
    frame = scene_frame(scene, preset)
    budget, why_budget = budget_for(scene, config)
    log2, why_log2 = table_size_for(budget, config)
    if config.background is not None:
        background, why_background = config.background, "asked for"
    else:
        background = preset != "synthetic" or not scene.has_alpha
        why_background = f"preset {preset}" + ("" if background else ", photos with transparency")

    base, finest = config.grid_resolutions
    model_config = ModelConfig(
        frame=frame,
        geometry=HashGridConfig(max(4, log2 - 1), base=base, finest=finest),
        radiance=HashGridConfig(log2, base=base, finest=finest),
        background=background,
        solid=BACKGROUND_RGB[config.background_color],
        direction_encoding=config.direction_encoding,
        antialiased=config.antialiased,
    )
    if has_narrow_decoders(config):
        model_config = replace(model_config, hidden=NARROW_WIDTH)
    cache = cache or PictureCache(0)
    color = first_color(scene, cache, np.array(model_config.solid, np.float32) if background else None)
    pictures = cache if config.surface_points else None
    points, colors, source = initial_points(scene, frame, budget, config.seed, pictures)
    model = HybridModel(model_config, _gaussians(points, colors, model_config), _generator(config.seed))
    start_fields_at(model, color)
    choices = {
        "preset": f"{preset}: {why_preset}",
        "max_gaussians": f"{budget:,}: {why_budget}",
        "log2_table_size": f"{log2}: {why_log2}",
        "background": f"{'sphere' if background else 'none'}: {why_background}",
        "initial_gaussians": f"{len(points):,}: {source}",
    }
    if has_narrow_decoders(config):
        choices["hidden"] = f"{NARROW_WIDTH}: the target size is below {MIN_WIDE_TARGET_BYTES:,} bytes"
    return model, budget, choices


def initial_points(
    scene: Scene, frame: Frame, budget: int, seed: int, cache: PictureCache | None = None
) -> tuple[np.ndarray, np.ndarray, str]:
    """Choose initial points, at most as many as the budget.

    They are the scene's points, or a random subset of them. If there are fewer than the budget, `draw_surface_points`
    adds others from photos read by `cache`; None adds none. If all these are fewer than half of the budget, because the
    points are few or no photo shows them, random points in the box take their place as guides to surfaces. A scene
    without points starts from surfaces alone, and random points make up half of the budget where these are few; if
    photos have transparency, these lie in the visual hull. Outliers are moved along the line to the frame's centre
    until half precision can represent their coordinates.

    Returns:
        Local positions (N, 3) float64, colours (N, 3) in [0, 1], and where they come from, in words.
    """
    generator = np.random.default_rng(seed)
    points, colors = scene.points, np.asarray(scene.point_colors, np.float64)
    if len(points) > budget:
        chosen = np.sort(generator.choice(len(points), budget, replace=False))
        points, colors = points[chosen], colors[chosen]
    given = len(points)
    if 0 < given < budget and cache is not None:
        more, more_colors = draw_surface_points(scene, cache, budget - given, generator)
        points, colors = np.concatenate([points, more]), np.concatenate([colors, more_colors])
    points = _representable(frame.to_local(points))
    drawn, missing, where = len(points) - given, max(1, budget // 2) - len(points), ""
    if missing > 0 and (cache is not None or not given):
        random, random_colors, where = _random_points(scene, frame, max(1, budget // 2), generator)
        if cache is not None:
            # They say which photos show the same place, and how near surfaces can be.
            guides = replace(
                scene, points=frame.to_world(random), point_colors=random_colors.astype(np.float32), tracks={}
            )
            more, more_colors = draw_surface_points(guides, cache, budget - len(points), generator)
            points = np.concatenate([points, _representable(frame.to_local(more))])
            colors = np.concatenate([colors, more_colors])
            drawn, missing = drawn + len(more), max(0, missing - len(more))
        if not given:
            points, colors = (
                np.concatenate([points, random[:missing]]),
                np.concatenate([colors, random_colors[:missing]]),
            )
    return points, colors, _source_in_words(given, drawn, len(points) - given - drawn, where)


def _source_in_words(given: int, drawn: int, random: int, where: str) -> str:
    """Say where initial points come from: of the scene, drawn on surfaces, and random ones at a place `where`."""
    if given:
        return (
            f"{given:,} points of the scene, the others on surfaces that photos show"
            if drawn
            else "points of the scene"
        )
    if not random:
        return "on surfaces that photos show"
    return f"{drawn:,} on surfaces that photos show, the others random, {where}" if drawn else f"random, {where}"


def _random_points(
    scene: Scene, frame: Frame, count: int, generator: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, str]:
    """Draw random points: local positions (count, 3), colours (count, 3), and where they lie, in words."""
    if scene.has_alpha:
        return *inside_silhouettes(scene, frame, count, generator), "inside the silhouettes"
    half = np.array(frame.half_extent)
    return generator.uniform(-half, half, (count, 3)), np.full((count, 3), 0.5), "in the box"


def _representable(local: np.ndarray) -> np.ndarray:
    """Move local points (N, 3) towards the origin until half precision can represent their coordinates."""
    largest = np.abs(local).max(axis=1, keepdims=True)
    return np.asarray(local / np.maximum(1, largest / MAX_INITIAL_COORDINATE))


def _gaussians(points: np.ndarray, colors: np.ndarray, config: ModelConfig) -> Gaussians:
    """Place Gaussians at points; their standard deviation is the rms distance to the 3 nearest points."""
    positions = torch.from_numpy(points).float()
    bounds = scale_bounds(positions, config)
    if len(points) > 1:
        distances, _ = cKDTree(points).query(points, k=min(4, len(points)))
        sizes = np.sqrt((distances[:, 1:] ** 2).mean(1))
    else:
        sizes = np.full(len(points), 0.1)
    fraction = (torch.from_numpy(sizes).float()[:, None] / bounds).clamp(MIN_INITIAL_SIZE, MAX_INITIAL_SIZE)
    return Gaussians(
        positions,
        logit(torch.from_numpy(np.clip(colors, 0.02, 0.98))),
        logit(fraction),
        logit(torch.full((len(points), 1), INITIAL_OPACITY)),
    )


def _generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)

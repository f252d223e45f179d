"""From a scene to an untrained model: regime, frame, sizes and the first Gaussians.

"Model only what a scene needs": every size here follows from the photos and the length of the run, and each choice
is recorded with its reason, for `hyrfpack info`.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from scipy.spatial import cKDTree

from hyrfpack.cameras.capture import quantized_provenance, scene_provenance
from hyrfpack.cameras.paths import common_direction
from hyrfpack.errors import HyrfTrainingError
from hyrfpack.format.min_file_size import check_target_bytes
from hyrfpack.model import Frame, HashGridConfig, HybridModel, ModelConfig
from hyrfpack.model.gaussians import Gaussians, logit
from hyrfpack.model.hybrid import scale_bounds
from hyrfpack.scene import Scene
from hyrfpack.train.config import FULL_STEPS, TrainConfig
from hyrfpack.train.silhouette import inside_silhouettes

SYNTHETIC_HALF_BOX = 1.3  # NeRF-synthetic objects lie in [-1.3, 1.3]^3
# Gaussians that a full-length run may have, whichever is more: for each pixel of one photo, or of all of them
# (Mip-NeRF 360 at 1 megapixel: 0.85 and 0.9 million; published models have up to 2.5).
PER_PHOTO_PIXEL, PER_PIXEL = 0.85, 1 / 240
LEAST_BUDGET = 5_000
# Bytes of decoders and headers in a packed file, and of each Gaussian with its table rows. By itself `compress` takes 2
# to 6 bytes for a Gaussian, most often 4 to 5: of the same bytes, more and coarser ones are better.
PACKED, PACKED_GAUSSIAN = 8_000, 3.5
LEAST_TARGETED = 250  # Gaussians, however small the file shall be
LARGER = 2  # at most: how many times the usual budget a target size may bring
GAUSSIANS_PER_ROW = 20  # for each row and level of the radiance table; the paper's models have 8 to 20
INITIAL_OPACITY = 0.1
INITIAL_SIZE = (1e-5, 0.5)  # local units over S(p)
FARTHEST = 1e4  # local units per axis; to pull in what is farther turns it by 2e-4 radians at most, seen from the box
ONE_PLACE = 1e-3  # cameras spread by less than this share of their distance to the points see it all from one place
BACKGROUND_RGB = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0), "random": (0.0, 0.0, 0.0)}


def detect_preset(scene: Scene) -> tuple[str, str]:
    """The paper's regime that fits a scene, and the reason in words.

    - "synthetic": photos with coverage (an object without a background);
    - "large": the cameras look the same way and fly across it (aerial surveys);
    - "street": the cameras look the same way and move along it;
    - "standard": everything else.
    """
    if scene.has_alpha or scene.layout == "blender":
        return "synthetic", "the photos have transparency" if scene.has_alpha else "the layout is NeRF-synthetic's"
    cameras = [view.camera for view in scene.train]
    axis = common_direction(cameras)
    if axis is None or len(scene.points) == 0:
        return "standard", "the cameras look in different directions" if axis is None else "the scene has no points"
    positions = np.array([camera.position for camera in cameras])
    offsets = positions - positions.mean(0)
    along = float(np.ptp(offsets @ axis))
    across = float(np.linalg.norm(np.ptp(offsets - np.outer(offsets @ axis, axis), axis=0)))
    depth = float(np.median((scene.points - positions.mean(0)) @ axis))
    if along > 2 * across and along > depth:
        return "street", "the cameras move along the direction they look in"
    if across > 0.5 * abs(depth):
        return "large", "the cameras look the same way and fly across it"
    return "standard", "the cameras look the same way from nearly one place"


def scene_frame(scene: Scene, preset: str) -> Frame:
    """The box B0 of a scene under a regime, in the scene's own axes.

    NeRF-synthetic layouts +-1.3 around the origin; "synthetic" ones of other layouts, where the unit is not known,
    and "large" the 1st to 99th percentile of the points; otherwise the box of the cameras, or of the points where the
    cameras share one place.
    """
    if preset == "synthetic" and scene.layout == "blender":
        return Frame((0.0, 0.0, 0.0), SYNTHETIC_HALF_BOX, (1.0, 1.0, 1.0))
    positions = np.array([view.camera.position for view in scene.train])
    low, high = positions.min(0), positions.max(0)
    if len(scene.points):
        reach = float(np.median(np.linalg.norm(scene.points - positions.mean(0), axis=1)))
        if preset in ("large", "synthetic") or (high - low).max() <= ONE_PLACE * reach:
            low, high = np.percentile(scene.points, [1, 99], axis=0)
    # No points, or all coincident, and one place (up to rounding): a box of unit size in front of the first camera.
    if (high - low).max() <= 1e-9 * np.abs(positions).max():
        forward = scene.train[0].camera.forward
        low, high = positions[0] + forward - 1, positions[0] + forward + 1
    return Frame.from_box(low, high)


def budget_for(scene: Scene, config: TrainConfig) -> tuple[int, str]:
    """The most Gaussians a run may have, and why.

    It is the configured factor times what follows from the photos' pixels and, as a shorter run can fit fewer, from the
    square root of its length. Of a target size it is about what fits in, and at most `LARGER` times as many as without.
    """
    if config.max_gaussians is not None:
        return config.max_gaussians, "asked for"
    pixels = sum(view.camera.width * view.camera.height for view in scene.train)
    full = max(PER_PHOTO_PIXEL * pixels / len(scene.train), PER_PIXEL * pixels)
    length = math.sqrt(min(1.0, config.steps / FULL_STEPS))
    budget, why = max(LEAST_BUDGET, round(full * length)), f"{pixels:,} pixels in all, {config.steps:,} steps"
    if config.target_bytes is not None:
        fitting = max(LEAST_TARGETED, round((config.target_bytes - PACKED) / PACKED_GAUSSIAN))
        if fitting <= LARGER * budget:
            return fitting, f"to be packed into {config.target_bytes:,} bytes"
        return LARGER * budget, f"{LARGER} times what suits {why}"
    if config.budget_factor not in (None, 1):
        return max(1, round(config.budget_factor * budget)), f"{config.budget_factor:g} times what suits {why}"
    return budget, why


def check_target(scene: Scene, config: TrainConfig) -> None:
    """Refuse a target size that no packed model of these photos can have.

    A file carries some of the cameras, so that its smallest size depends on the scene.

    Raises:
        HyrfError: the target size is below that.
    """
    if config.target_bytes is None or not scene.train:
        return
    preset = config.preset if config.preset != "auto" else detect_preset(scene)[0]
    provenance = {"steps": config.steps, "seed": config.seed, **scene_provenance(scene)}
    check_target_bytes(config.target_bytes, quantized_provenance(provenance, scene_frame(scene, preset).scale))


def table_size_for(budget: int, config: TrainConfig) -> tuple[int, str]:
    """log2 of the radiance table's rows per level for that many Gaussians, and why."""
    if config.log2_table_size is not None:
        return config.log2_table_size, "asked for"
    log2 = round(math.log2(max(1, budget / GAUSSIANS_PER_ROW)))
    return min(21, max(8, log2)), f"{GAUSSIANS_PER_ROW} Gaussians for each row and level"


def build_model(scene: Scene, config: TrainConfig) -> tuple[HybridModel, int, dict[str, str]]:
    """An untrained model for a scene.

    Returns:
        The model, its budget of Gaussians, and the choices made, each with its reason.

    Raises:
        HyrfTrainingError: the scene has no training views.
    """
    if not scene.train:
        raise HyrfTrainingError(
            f"{scene.path}: no views are left for training; use fewer test views (`test_every=0` trains on all)"
        )
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
        scale_rule=config.scale_rule,
        scale_grows=config.scale_grows,
        direction_encoding=config.direction_encoding,
        position_gradients=config.position_gradients,
        antialiased=config.antialiased,
    )
    points, colors = initial_points(scene, frame, budget, config.seed)
    if len(scene.points):
        source = "points of the scene"
    else:
        source = "random, inside the silhouettes" if scene.has_alpha else "random, in the box"
    model = HybridModel(model_config, _gaussians(points, colors, model_config), _generator(config.seed))
    choices = {
        "preset": f"{preset}: {why_preset}",
        "max_gaussians": f"{budget:,}: {why_budget}",
        "log2_table_size": f"{log2}: {why_log2}",
        "background": f"{'sphere' if background else 'none'}: {why_background}",
        "initial_gaussians": f"{len(points):,}: {source}",
    }
    return model, budget, choices


def initial_points(scene: Scene, frame: Frame, budget: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Local positions (N, 3) float64 and colours (N, 3) in [0, 1] to start from, N at most the budget.

    The scene's points (a random part of them if they are too many), or without points half a budget of random ones
    in the box - for photos with coverage only where all silhouettes agree. Points that a reconstruction flung far out
    are pulled in, along the line to the frame's centre, to where half precision still holds them.
    """
    generator = np.random.default_rng(seed)
    if len(scene.points):
        points, colors = frame.to_local(scene.points), np.asarray(scene.point_colors, np.float64)
        if len(points) > budget:
            chosen = np.sort(generator.choice(len(points), budget, replace=False))
            points, colors = points[chosen], colors[chosen]
        return points / np.maximum(1, np.abs(points).max(axis=1, keepdims=True) / FARTHEST), colors
    count = max(1, budget // 2)
    half = np.array(frame.half_extent)
    if not scene.has_alpha:
        return generator.uniform(-half, half, (count, 3)), np.full((count, 3), 0.5)
    return inside_silhouettes(scene, frame, count, generator)


def _gaussians(points: np.ndarray, colors: np.ndarray, config: ModelConfig) -> Gaussians:
    """Gaussians at points, as large as the gaps between them: sigma is the rms distance to the 3 nearest."""
    positions = torch.from_numpy(points).float()
    bounds = scale_bounds(positions, config)
    if len(points) > 1:
        distances, _ = cKDTree(points).query(points, k=min(4, len(points)))
        sizes = np.sqrt((distances[:, 1:] ** 2).mean(1))
    else:
        sizes = np.full(len(points), 0.1)
    fraction = (torch.from_numpy(sizes).float()[:, None] / bounds).clamp(*INITIAL_SIZE)
    if config.scale_rule == "product":
        fraction = (2 * fraction).clamp(max=0.999)  # the neural factor starts at a half
    return Gaussians(
        positions,
        logit(torch.from_numpy(np.clip(colors, 0.02, 0.98))),
        logit(fraction),
        logit(torch.full((len(points), 1), INITIAL_OPACITY)),
    )


def _generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)

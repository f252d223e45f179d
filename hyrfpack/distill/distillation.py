"""Distil splats into a model: choose viewpoints, initialise by regression, train on reference renders."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from hyrfpack.cameras.view_sampling import sample_views, shrink_camera
from hyrfpack.config.distill import DistillConfig
from hyrfpack.config.settings import LARGEST_SEED
from hyrfpack.config.train import DensityConfig, LearningRates, TrainConfig
from hyrfpack.data import PictureCache
from hyrfpack.distill.initialize import initial_model
from hyrfpack.distill.reference import ReferenceViews, mean_sent_light, reference_scene
from hyrfpack.distill.residuals import exact_model
from hyrfpack.errors import HyrfDataError
from hyrfpack.model import HybridModel
from hyrfpack.progress import Progress, StepEvent, TaskEvent, ignore_progress, part_of_progress
from hyrfpack.progress.status import format_psnr
from hyrfpack.scene import Camera, Scene, evenly_spaced
from hyrfpack.splats.draw import Drawable
from hyrfpack.splats.splats import Splats
from hyrfpack.splats.viewpoints import WeightedSplats, has_enclosed_places, sample_viewpoints
from hyrfpack.train.trainer import Trainer

_LOG = logging.getLogger(__name__)

# Compression is decided on more views than are scored, because the mean PSNR of few views is off by up to 1 dB.
VALIDATION_VIEWS_PER_TEST_VIEW = 3
TEST_EVERY = 8
LIGHT_MEASUREMENT_VIEWS = 64
# The faintest Gaussians that together send less than this share of all light are left out.
FAINT_LIGHT_SHARE = 0.01
FAINT_LIGHT_SHARE_WITH_RESIDUALS = 1e-4  # Compression prunes the others as the target PSNR allows.
# The regression has its full length from this many training steps on, and is proportionally shorter below.
FULL_REGRESSION_STEPS = 250
MIN_REGRESSION_SHARE = 0.2
# The initial model is close to the original, so learning rates are low.
WARM_START_RATES = LearningRates(
    positions=(2e-6, 2e-7),
    fields=(3e-4, 3e-5),
    color_logits=(3e-3, 3e-4),
    scale_logits=(3e-3, 3e-4),
    opacity_logits=(6e-3, 6e-4),
)


@dataclass(frozen=True)
class DistilledModel:
    """A model distilled from splats, before compression, with reference renders of the splats.

    Attributes:
        model: the model.
        train: cameras of the training views.
        validation: reference renders on which the compression is decided.
        test: held-out reference renders, for scores.
        exact: the splats of the model, if its residuals make it equal to them; None without residuals.
    """

    model: HybridModel
    train: list[Camera]
    validation: ReferenceViews
    test: ReferenceViews
    exact: Drawable | None = None


def distill_model(
    splats: Splats,
    config: DistillConfig = DistillConfig(),  # noqa: B008 - frozen
    *,
    name: str = "the splats",
    cameras: Sequence[Camera] | None = None,
    device: torch.device = torch.device("cpu"),  # noqa: B008 - a constant
    progress: Progress = ignore_progress,
) -> DistilledModel:
    """Train a hybrid model to look like splats. Arguments and errors are those of `distill_splats`.

    Example:
        >>> from hyrfpack.splats.files import read_splats
        >>> quick = DistillConfig(steps=1, size=16, train_views=2, test_views=2)
        >>> len(distill_model(read_splats("bonsai.ply"), quick).model) > 0
        True
    """
    progress(TaskEvent("choosing viewpoints", 0.0))
    weighted = WeightedSplats.from_splats(splats, name)
    original = Drawable.from_splats(splats, weighted.frame, device)
    train, validation, test = _choose_cameras(weighted, original, config, cameras)
    _LOG.info(
        f"{len(splats):,} Gaussians, harmonics of degree {splats.degree}; {len(train)} "
        f"{'sampled' if cameras is None else 'given'} viewpoints for training, {len(test)} held out"
    )
    progress(TaskEvent("measuring which Gaussians are visible", 0.05))
    light = mean_sent_light(original, evenly_spaced(train, LIGHT_MEASUREMENT_VIEWS))
    faint_share = FAINT_LIGHT_SHARE_WITH_RESIDUALS if config.has_residuals else FAINT_LIGHT_SHARE
    kept = torch.from_numpy(_indices_without_faint(light.cpu().numpy(), faint_share)).to(device)
    if not len(kept):
        raise HyrfDataError(f"{name}: no view shows anything of the Gaussians", fix="give others with `cameras`")
    _LOG.info(
        f"{len(splats) - len(kept):,} Gaussians are hardly visible and are left out; fitting the fields to the others"
    )
    share = min(1.0, max(MIN_REGRESSION_SHARE, config.steps / FULL_REGRESSION_STEPS))
    exact = original[kept] if config.has_residuals else None
    # Residuals hold all colours that depend on the view, so there is no radiance field beside them.
    fitted = original[kept] if exact is None else replace(exact, harmonics=exact.harmonics[:, :1])
    model = initial_model(fitted, light[kept], train, config.seed, share, part_of_progress(progress, 0.1, 0.4))
    if exact is None:
        scene, cache = reference_scene(name, original, train, test), PictureCache()
        _fit_to_pictures(model, scene, config, cache, part_of_progress(progress, 0.4, 0.98))
    else:
        model = exact_model(model, exact)
    progress(TaskEvent("rendering held-out views", 0.98))
    validation_views, test_views = (ReferenceViews.from_splats(original, views) for views in (validation, test))
    return DistilledModel(model, train, validation_views, test_views, exact)


def _choose_cameras(
    weighted: WeightedSplats, drawable: Drawable, config: DistillConfig, cameras: Sequence[Camera] | None
) -> tuple[list[Camera], list[Camera], list[Camera]]:
    """Return the training, validation and test cameras; validation and test views are disjoint.

    A single given camera is used for both training and test.
    """
    if cameras is None:
        # Each step takes one view, so more training views than steps would not be used.
        train_count = min(config.train_views, max(LIGHT_MEASUREMENT_VIEWS, config.steps))
        # The three seeds differ from each other and from those of any other config.seed.
        seeds = 2 * config.seed, 2 * (LARGEST_SEED + 1) + config.seed, 2 * config.seed + 1
        inside = has_enclosed_places(weighted, drawable)
        train, validation, test = (
            sample_viewpoints(weighted, drawable, count, config.size, seed, inside)
            for count, seed in zip(
                (train_count, VALIDATION_VIEWS_PER_TEST_VIEW * config.test_views, config.test_views), seeds, strict=True
            )
        )
        return train, validation, test
    shrunk = [shrink_camera(camera, config.size) for camera in cameras]
    test = shrunk[::TEST_EVERY]
    train = [camera for number, camera in enumerate(shrunk) if number % TEST_EVERY] or test
    return train, sample_views(train, config.test_views, config.seed)[1], test


def _indices_without_faint(light: np.ndarray, share: float = FAINT_LIGHT_SHARE) -> np.ndarray:
    """Return ascending indices (n,) of all Gaussians but the faintest, given the light (N,) that each sends.

    The faintest are those that together send `share` of all light, or none.
    """
    order = np.argsort(light, kind="stable")
    sums = np.cumsum(light[order].astype(np.float64))
    return np.sort(order[(sums > share * sums[-1]) & (light[order] > 0)]) if len(order) else order


def _fit_to_pictures(
    model: HybridModel, scene: Scene, config: DistillConfig, cache: PictureCache, progress: Progress
) -> None:
    """Train a model on reference renders, starting from its current state."""
    # Density control is off: the Gaussians are in place already, and compression prunes those of low importance.
    settings = TrainConfig(
        steps=config.steps,
        resolution_schedule=False,
        seed=config.seed,
        learning_rates=WARM_START_RATES,
        density=DensityConfig(stop=0.0),
        precision="float32",  # Lower precisions on a GPU round more than the corrections that remain.
    )
    trainer = Trainer(scene, settings, cache, model.gaussians.positions.device, model)

    def report_step(event: StepEvent) -> None:
        task = f"training, step {event.step}/{event.steps}, {format_psnr(event.mse)}"
        progress(TaskEvent(task, event.step / event.steps))

    trainer.run(progress=report_step)

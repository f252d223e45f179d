"""Decide by pilot runs, before a scene is trained, on per-image gains, the Gaussian budget and the number of steps."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import torch

from hyrfpack.config.train import TrainConfig
from hyrfpack.data import PictureCache
from hyrfpack.progress import Progress, ignore_progress
from hyrfpack.scene import Scene
from hyrfpack.train.budget_pilots import BUDGET_PILOT_STEPS, MAX_BUDGET_ROUNDS, measure_budget
from hyrfpack.train.exposure_pilots import (
    EXPOSURE_PILOT_REDUCTION,
    exposure_pilot_steps,
    exposure_rounds,
    measure_exposure,
)
from hyrfpack.train.length_pilots import max_length_pilot_steps, measure_length, pilot_lengths
from hyrfpack.train.pilot_journal import PilotJournal, PilotScore
from hyrfpack.train.pilots import MIN_TRAINING_VIEWS, ScenePilots, pilot_step_cost
from hyrfpack.train.resolution import PhotoSize
from hyrfpack.train.stop import TrainingStopped
from hyrfpack.train.teachers import count_teachers
from hyrfpack.train.trainer import Trainer

# Shorter runs have no pilots, which would take too large a part of their time.
MIN_BUDGET_STEPS = 2_000
MIN_EXPOSURE_STEPS = 1_000
# Pilots have no virtual views, without which more Gaussians fit few photos more wrongly (docs/research/few-photos.md).
MIN_BUDGET_FACTOR_WITH_VIRTUAL_VIEWS = 0.5
MAX_BUDGET_PILOT_STEPS = 2 * MAX_BUDGET_ROUNDS * BUDGET_PILOT_STEPS


@dataclass(frozen=True)
class Decisions:
    """Decisions and the pilot scores that they are based on.

    Attributes:
        config: the settings of the run, including the decisions.
        reasons: the reason for each decision in words, by setting: "exposure", "max_gaussians", "steps".
        scores: the scores of each pilot.
    """

    config: TrainConfig
    reasons: dict[str, str]
    scores: list[PilotScore]


def is_budget_open(config: TrainConfig) -> bool:
    """Return whether no setting determines the Gaussian budget."""
    return config.budget_factor is None and config.max_gaussians is None and config.target_bytes is None


def measures_budget(scene: Scene, config: TrainConfig) -> bool:
    """Return whether pilots estimate the budget: no setting fixes it, and run and photos are large enough."""
    return is_budget_open(config) and config.steps >= MIN_BUDGET_STEPS and len(scene.train) >= MIN_TRAINING_VIEWS


def measures_exposure(scene: Scene, config: TrainConfig) -> bool:
    """Return whether pilots decide on per-image gains: no setting does, and run and photos are large enough."""
    is_open = config.exposure is None and not scene.has_alpha
    return is_open and config.steps >= MIN_EXPOSURE_STEPS and len(scene.train) >= MIN_TRAINING_VIEWS


def measures_length(scene: Scene, config: TrainConfig) -> bool:
    """Return whether pilots choose the number of steps: `early_stop` is on, and the run is long for its photos."""
    return config.early_stop and max_length_pilot_steps(len(scene.train), config.steps) > 0


def chosen_steps(scene: Scene, config: TrainConfig, steps: object, asked_steps: int | None) -> int:
    """Return the number of steps with which a call completes an earlier run.

    Args:
        scene, config: photos and settings of the call.
        steps: number of steps of the earlier run, as read from a file.
        asked_steps: number of steps that the earlier run was asked for; None if the file does not state it.

    Returns:
        `steps` if pilots may have chosen it for a run with these settings, else `config.steps`.
    """
    could_be_chosen = (
        asked_steps in (None, config.steps) and measures_length(scene, config) and steps in pilot_lengths(config.steps)
    )
    return steps if could_be_chosen and isinstance(steps, int) else config.steps


def max_pilot_steps(scene: Scene, config: TrainConfig) -> float:
    """Return the most steps that all pilots of a run take, see `max_exposure_pilot_steps`.

    On reduced photos a step counts less, see `Fold`.
    """
    budget = MAX_BUDGET_PILOT_STEPS * measures_budget(scene, config)
    exposure = max_exposure_pilot_steps(len(scene.train), config.steps) * measures_exposure(scene, config)
    length = max_length_pilot_steps(len(scene.train), config.steps) * config.early_stop
    return budget + exposure + length


def max_exposure_pilot_steps(count: int, steps: int) -> float:
    """Return the most steps that the pilots for exposure take before a run of `steps` steps on `count` photos.

    Masks and photos of one position may take further rounds, which are not counted. Steps on reduced photos count less,
    see `Fold`.
    """
    return 2 * exposure_rounds(count) * exposure_pilot_steps(steps) * pilot_step_cost(EXPOSURE_PILOT_REDUCTION)


def without_pilots(config: TrainConfig) -> Decisions:
    """Return safe defaults for what the settings leave open: no per-image gains and the usual budget."""
    return Decisions(dataclasses.replace(config, exposure=bool(config.exposure)), {}, [])


def decide(
    scene: Scene,
    config: TrainConfig,
    cache: PictureCache,
    device: torch.device,
    progress: Progress = ignore_progress,
    stop: Callable[[], bool] = lambda: False,
    observer: Callable[[Trainer], None] | None = None,
    journal: PilotJournal | None = None,
) -> Decisions | None:
    """Decide by pilot runs what the settings leave open: first exposure compensation, then the budget, then the length.

    Args:
        scene, config, cache, device, progress, stop, observer, journal: see `ScenePilots`.

    Returns:
        The decisions; None if `stop` ended the pilots.

    Raises:
        HyrfError: as `Trainer.run`; a photo cannot be read.
    """
    decided = without_pilots(config).config
    max_steps = max_pilot_steps(scene, config)
    pilots = ScenePilots(scene, decided, cache, device, progress, stop, max_steps, observer, journal)
    reasons: dict[str, str] = {}
    try:
        if measures_exposure(scene, config):
            exposure, reasons["exposure"] = measure_exposure(pilots)
            decided = dataclasses.replace(decided, exposure=exposure)
        if measures_budget(scene, config):
            factor, reason = measure_budget(pilots, bool(decided.exposure))
            has_virtual_views = count_teachers(len(scene.train), PhotoSize.of_views(scene.train), config) > 0
            if has_virtual_views and factor < MIN_BUDGET_FACTOR_WITH_VIRTUAL_VIEWS:
                factor, reason = MIN_BUDGET_FACTOR_WITH_VIRTUAL_VIEWS, f"{reason}; the least with virtual views"
            decided = dataclasses.replace(decided, budget_factor=factor)
            reasons["max_gaussians"] = reason
        if measures_length(scene, config):
            steps, reasons["steps"] = measure_length(pilots, bool(decided.exposure), decided.budget_factor)
            decided = dataclasses.replace(decided, steps=steps)
    except TrainingStopped:
        return None
    return None if stop() else Decisions(decided, reasons, pilots.scores)

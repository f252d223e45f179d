"""What pilot runs decide for a scene before it is trained: per-image gains or none, and the Gaussian budget."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import torch

from hyrfpack.data import PictureCache
from hyrfpack.scene import Scene
from hyrfpack.train.budget_pilots import BUDGET_PILOT_STEPS, MAX_BUDGET_ROUNDS, measure_budget
from hyrfpack.train.config import TrainConfig
from hyrfpack.train.exposure_pilots import (
    EXPOSURE_PILOT_STEPS,
    EXPOSURE_VALIDATION_EVERY,
    MAX_EXPOSURE_ROUNDS,
    MAX_EXPOSURE_VALIDATION_VIEWS,
    measure_exposure,
)
from hyrfpack.train.pilots import MIN_TRAINING_VIEWS, Phase, PilotScore, PilotsStopped, Report, ScenePilots

MIN_BUDGET_STEPS = 2_000  # of a run that the pilots for the budget take little of
MIN_EXPOSURE_STEPS = 1_000  # and of one that the pilots for exposure do
MAX_BUDGET_PILOT_STEPS = 2 * MAX_BUDGET_ROUNDS * BUDGET_PILOT_STEPS
MAX_EXPOSURE_PILOT_STEPS = 2 * MAX_EXPOSURE_ROUNDS * EXPOSURE_PILOT_STEPS
MAX_PILOT_STEPS = MAX_BUDGET_PILOT_STEPS + MAX_EXPOSURE_PILOT_STEPS


@dataclass(frozen=True)
class Decisions:
    """What was decided.

    Attributes:
        config: the settings, with nothing left to decide.
        reasons: in words, by what was decided: "exposure", "max_gaussians".
        scores: the evidence: of each pilot.
    """

    config: TrainConfig
    reasons: dict[str, str]
    scores: list[PilotScore]


def is_budget_open(config: TrainConfig) -> bool:
    """Whether no setting says how many Gaussians there shall be."""
    return config.budget_factor is None and config.max_gaussians is None and config.target_bytes is None


def measures_budget(scene: Scene, config: TrainConfig) -> bool:
    """Whether pilots measure the budget: it is open, they take little of the run, and there are enough photos."""
    return is_budget_open(config) and config.steps >= MIN_BUDGET_STEPS and len(scene.train) >= MIN_TRAINING_VIEWS


def measures_exposure(scene: Scene, config: TrainConfig) -> bool:
    """Whether pilots decide on per-image gains: nobody has, they take little of the run, and photos can have gains."""
    is_open = config.exposure is None and not scene.has_alpha
    return is_open and config.steps >= MIN_EXPOSURE_STEPS and len(scene.train) >= MIN_TRAINING_VIEWS


def max_pilot_steps(scene: Scene, config: TrainConfig) -> int:
    """The most steps that all pilots of a run take."""
    budget = MAX_BUDGET_PILOT_STEPS * measures_budget(scene, config)
    return budget + MAX_EXPOSURE_PILOT_STEPS * measures_exposure(scene, config)


def without_pilots(config: TrainConfig) -> Decisions:
    """The safe defaults of what the settings leave open: no gains, the usual budget."""
    return Decisions(dataclasses.replace(config, exposure=bool(config.exposure)), {}, [])


def decide(
    scene: Scene,
    config: TrainConfig,
    cache: PictureCache,
    device: torch.device,
    report: Report = lambda step, loss, mse, gaussians: None,
    stop: Callable[[], bool] = lambda: False,
    phase: Phase = lambda what, done, total: None,
) -> Decisions | None:
    """Decide by pilot runs what the settings leave open, the exposure first.

    Args:
        scene, config, cache, device, report, stop, phase: see `ScenePilots`.

    Returns:
        The decisions; None where it was stopped.

    Raises:
        HyrfError: as `Trainer.run`; a photo cannot be read.
    """
    decides_exposure, decides_budget = measures_exposure(scene, config), measures_budget(scene, config)
    settled = without_pilots(config).config
    reasons: dict[str, str] = {}
    scores: list[PilotScore] = []
    steps = 0
    try:
        if decides_exposure:
            pilots = ScenePilots(
                scene, settled, cache, device, report, stop, phase,
                validation_every=EXPOSURE_VALIDATION_EVERY, max_validation=MAX_EXPOSURE_VALIDATION_VIEWS,
            )  # fmt: skip
            exposure, reasons["exposure"] = measure_exposure(pilots)
            settled = dataclasses.replace(settled, exposure=exposure)
            scores, steps = pilots.scores, pilots.steps
        if decides_budget:
            pilots = ScenePilots(scene, settled, cache, device, report, stop, phase, steps_before=steps)
            factor, reasons["max_gaussians"] = measure_budget(pilots)
            settled = dataclasses.replace(settled, budget_factor=factor)
            scores = [*scores, *pilots.scores]
    except PilotsStopped:
        return None
    return None if stop() else Decisions(settled, reasons, scores)

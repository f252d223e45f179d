"""Pilot runs: short training runs before the main run, scored on validation photos taken from the training photos.

Held-out photos are not used.
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np
import torch

from hyrfpack.config.train import TrainConfig
from hyrfpack.data import PictureCache
from hyrfpack.data.reduced import reduce_view
from hyrfpack.errors import HyrfTrainingError
from hyrfpack.evaluate import Evaluation, evaluate_model
from hyrfpack.progress import Progress, StepEvent, TaskEvent, ignore_progress, items_of_progress
from hyrfpack.scene import Picture, Scene, View, evenly_spaced
from hyrfpack.train.pilot_journal import PilotJournal, PilotScore, pilot_key
from hyrfpack.train.setup import budget_for
from hyrfpack.train.stop import TrainingStopped
from hyrfpack.train.trainer import Trainer

_LOG = logging.getLogger(__name__)

BUDGET_REFERENCE_STEPS = 500  # By default a pilot has the budget of a run of this length.
MAX_TRAINING_VIEWS = 150  # The shortest pilots have too few steps for more photos.
MAX_VALIDATION_VIEWS = 8
# Cameras nearer to each other than this share of the extent of all cameras are in one place, up to rounding.
MIN_PLACE_DISTANCE_RATIO = 1e-6
ROUNDING_RATIO = 1e-12  # Positions computed from poses differ by less than this share of them.
MIN_PLACES = 3  # Of fewer places, none can be left out.
MIN_TRAINING_VIEWS = 8  # With fewer photos, none can be spared for validation.
# One of SSIM counts as much as this many dB of PSNR. In the mean of twelve sets, new versions that raise PSNR by 1 dB
# raise SSIM by .022.
SSIM_WEIGHT_DB = 45.0


@dataclass(frozen=True)
class Fold:
    """One split of a scene's training photos into photos to train on and validation photos.

    Attributes:
        scene: the scene with only the photos that pilots train on.
        validation: the photos that pilots are scored on; empty if masks leave no pixel of them.
        max_gaussians: the budget of pilots that are run without another one.
        step_cost: time of a training step, as a share of the time on photos that are not reduced.
    """

    scene: Scene
    validation: list[View]
    max_gaussians: int
    step_cost: float = 1.0


class ScenePilots:
    """Runs pilots of one scene and keeps their scores.

    Attributes:
        scene, config, cache: the arguments of `__init__`.
        scores: the scores of all pilots so far.
        steps: number of steps that all pilots have taken so far; on reduced photos a step counts less, see `Fold`.
    """

    def __init__(
        self,
        scene: Scene,
        config: TrainConfig,
        cache: PictureCache,
        device: torch.device,
        progress: Progress = ignore_progress,
        stop: Callable[[], bool] = lambda: False,
        max_steps: float = 0,
        observer: Callable[[Trainer], None] | None = None,
        journal: PilotJournal | None = None,
    ) -> None:
        """Start without any scores.

        Args:
            scene: the scene; only its training photos are used.
            config: settings of the main run.
            cache: cache of decoded photos.
            device: where to train.
            progress: called with `TaskEvent`s, which have the number of steps, photos or views done, and that of all.
            stop: called after each step; True ends the pilots.
            max_steps: most steps that all pilots take; if given, the events of steps have the share of them.
            observer: called after each step with the trainer of the pilot.
            journal: pilots that are finished already are not run again, and other ones are kept in it.
        """
        self.scene, self.config, self.cache = scene, config, cache
        self._device, self._progress, self._stop, self._max_steps = device, progress, stop, max_steps
        self._observer, self._journal = observer, journal or PilotJournal()
        self.scores: list[PilotScore] = []
        self.steps = 0.0

    def fold(
        self,
        every: int | None = None,
        max_validation: int = MAX_VALIDATION_VIEWS,
        number: int = 0,
        reduction: int = 1,
    ) -> Fold:
        """Split the training photos, and read the validation photos.

        Args:
            every, max_validation, number: see `split`.
            reduction: factor by which width and height of all photos are reduced. The budget falls by its square.

        Raises:
            HyrfError: a photo cannot be read.
        """
        training, views = split(self.scene.train, every, max_validation, number)
        validation: list[View] = []
        for done, view in enumerate(reduce_view(view, reduction) for view in views):
            self._progress(TaskEvent("reading validation photos", done=done, total=len(views)))
            if is_usable(self.cache.get(view)):
                validation.append(view)
        scene = dataclasses.replace(self.scene, train=training, test=[])
        budget, _ = budget_for(scene, TrainConfig(steps=BUDGET_REFERENCE_STEPS))
        scene = dataclasses.replace(scene, train=[reduce_view(view, reduction) for view in training])
        return Fold(scene, validation, round(budget / reduction**2), pilot_step_cost(reduction))

    def run(
        self,
        name: str,
        fold: Fold,
        steps: int,
        *,
        seed: int,
        exposure: bool,
        max_gaussians: int | None = None,
        surface_points: bool | None = None,
    ) -> PilotScore:
        """Train a pilot and score it on the validation photos.

        Args:
            name: name of the pilot in progress lines ("budget pilot run 1/2").
            fold: photos to train on and validation photos.
            steps: number of steps of the pilot.
            seed, exposure, max_gaussians: replace those of the main run; without `max_gaussians` the fold's budget.
            surface_points: as in `TrainConfig`; None takes that of the main run.

        Raises:
            TrainingStopped: `stop` returned True.
            HyrfError: as `Trainer.run`.
        """
        max_gaussians = max_gaussians or fold.max_gaussians
        settings = dataclasses.replace(
            self.config,
            steps=steps,
            seed=seed,
            exposure=exposure,
            max_gaussians=max_gaussians,
            surface_points=self.config.surface_points if surface_points is None else surface_points,
            budget_factor=None,
            target_bytes=None,
        )
        key = pilot_key(settings, self.config.steps, fold.scene.train, fold.validation)
        score = self._journal.find(key)
        if score is None:
            score = self._train_and_score(name, fold, settings)
            self._journal.add(key, score)
        else:
            self.steps += fold.step_cost * steps
        self.scores.append(score)
        return score

    def _train_and_score(self, name: str, fold: Fold, settings: TrainConfig) -> PilotScore:
        """Train a pilot with these settings, from its checkpoint if there is one, and score it."""
        self._progress(TaskEvent(f"{name}: reading photos"))
        checkpoint = self._journal.checkpoint(settings.steps)
        trainer = self._set_up(fold, settings, checkpoint)
        before = self.steps

        def report_step(event: StepEvent) -> None:
            self.steps = before + fold.step_cost * event.step
            share = min(1.0, self.steps / self._max_steps) if self._max_steps else None
            self._progress(TaskEvent(f"{name}: training", share, event.step, settings.steps))
            if self._observer is not None:
                self._observer(trainer)

        trainer.run(checkpoint=checkpoint, progress=report_step, stop=self._stop)
        if self._stop():
            raise TrainingStopped
        count = len(fold.validation)
        result: Evaluation = evaluate_model(
            trainer.model,
            fold.validation,
            progress=items_of_progress(self._progress, f"{name}: scoring", count),
        )
        return PilotScore(
            steps=settings.steps,
            run_steps=self.config.steps,
            seed=settings.seed,
            max_gaussians=cast(int, settings.max_gaussians),
            exposure=cast(bool, settings.exposure),
            psnr=result.psnr,
            ssim=result.ssim,
            psnr_corrected=result.psnr_corrected,
            psnr_per_view=[view.psnr for view in result.views],
        )

    def _set_up(self, fold: Fold, settings: TrainConfig, checkpoint: Path | None) -> Trainer:
        """Return the trainer of a pilot, at the step of its checkpoint if that exists and is of the same pilot."""

        def make_trainer() -> Trainer:
            trainer = Trainer(fold.scene, settings, self.cache, self._device)
            trainer.kind = "pilot run"
            return trainer

        trainer = make_trainer()
        if checkpoint is not None and checkpoint.is_file():
            try:
                trainer.load(checkpoint)
            except HyrfTrainingError as error:
                _LOG.info(f"{error.problem}; this pilot run starts from its first step")
                return make_trainer()
        return trainer


def pilot_step_cost(reduction: int) -> float:
    """Return the time of a training step on reduced photos, relative to a step on the photos themselves.

    Measured: .35 for a reduction of 2, with a quarter of the pixels and of the Gaussians.

    Args:
        reduction: factor by which width and height are reduced; the number of Gaussians falls by its square.
    """
    return reduction**-1.5


def quality_score(psnr: float, ssim: float) -> float:
    """Return the score by which pilots are compared: PSNR in dB plus `SSIM_WEIGHT_DB` times SSIM."""
    return psnr + SSIM_WEIGHT_DB * ssim


def is_usable(picture: Picture) -> bool:
    """Return whether the picture has a pixel that is not masked."""
    return picture.mask is None or bool(picture.mask.any())


def split(
    views: Sequence[View], every: int | None = None, max_validation: int = MAX_VALIDATION_VIEWS, number: int = 0
) -> tuple[list[View], list[View]]:
    """Split photos into those that pilots train on and validation photos.

    Pilots train on the photos that are not validation photos. If these are more than `MAX_TRAINING_VIEWS`, only those
    nearest to a validation photo, in the order of views, are used. Photos spread over a large set would show too little
    of each place. Photos from one place, such as the faces of a panorama, are validated together: beside others of the
    same place and exposure, a validation photo would hardly be new.

    Args:
        every: the photos of one in `every` places are validation photos; None for 8, or 5 if there are fewer than 16
            places.
        max_validation: largest number of validation photos.
        number: number of the fold, from 0. The first `count_folds` have no validation photo in common.
    """
    places = _group_by_place(views)
    every = min(every or (8 if len(places) >= 16 else 5), len(places))
    tested = places[(every // 2 + number) % every :: every]
    chosen = evenly_spaced([n for place in tested for n in place], max_validation)
    left_out = {n for place in tested if not set(chosen).isdisjoint(place) for n in place}
    others = sorted(set(range(len(views))) - left_out, key=lambda n: min(abs(n - other) for other in chosen))
    return [views[n] for n in sorted(others[:MAX_TRAINING_VIEWS])], [views[n] for n in chosen]


def count_folds(views: Sequence[View], every: int) -> int:
    """Return how many folds of `split` have no validation photo in common: `every`, or fewer for few places."""
    return min(every, len(_group_by_place(views)))


def _group_by_place(views: Sequence[View]) -> list[list[int]]:
    """Return the places of the views taken from one camera position, in the order of the first one.

    If there are fewer than MIN_PLACES positions, each view is a place of its own.
    """
    centers = np.array([view.camera.position for view in views])
    extent = float(np.ptp(centers, axis=0).max())
    step = max(MIN_PLACE_DISTANCE_RATIO * extent, ROUNDING_RATIO * float(np.abs(centers).max())) or 1.0
    groups: dict[tuple[int, ...], list[int]] = {}
    for number, center in enumerate(centers - centers.min(axis=0)):
        groups.setdefault(tuple(np.rint(center / step).astype(np.int64)), []).append(number)
    return list(groups.values()) if len(groups) >= MIN_PLACES else [[number] for number in range(len(views))]

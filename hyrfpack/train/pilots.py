"""Pilot runs: short training runs before the long one, scored on validation photos taken from the training photos.

Held-out photos have no part in them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import torch

from hyrfpack.data import PictureCache
from hyrfpack.evaluate import Evaluation, evaluate_model
from hyrfpack.scene import Picture, Scene, View, evenly_spaced
from hyrfpack.train.config import TrainConfig
from hyrfpack.train.setup import budget_for
from hyrfpack.train.trainer import Trainer

BUDGET_REFERENCE_STEPS = 500  # A pilot has the budget of a run of this length, unless it asks for another one.
MAX_TRAINING_VIEWS = 150  # The shortest pilots have no steps for more photos.
MAX_VALIDATION_VIEWS = 8
MIN_TRAINING_VIEWS = 8  # With fewer photos, none can be spared for validation.

Report = Callable[[int, float, float, int], None]  # step, loss, mean squared error, Gaussians
Phase = Callable[[str, int, int], None]  # what is being done, items done, items in all (0: not known)


class PilotsStopped(Exception):
    """Raised when the run is asked to end during pilot runs."""


@dataclass(frozen=True)
class PilotScore:
    """The scores of one pilot run on the validation photos.

    Attributes:
        steps, seed: of the run.
        max_gaussians: its budget.
        exposure: whether per-image gains were learnt, and renders exposed by the map fitted to them.
        psnr, ssim, psnr_corrected: means over the validation photos, see `hyrfpack.Evaluation`.
        psnr_per_view: dB of each of them.
    """

    steps: int
    seed: int
    max_gaussians: int
    exposure: bool
    psnr: float
    ssim: float
    psnr_corrected: float
    psnr_per_view: list[float] = field(default_factory=list)


@dataclass(frozen=True)
class Fold:
    """One split of a scene's training photos.

    Attributes:
        scene: the scene with the photos that pilots train on, and none held out.
        validation: the photos that pilots are scored on; empty where masks leave nothing of them.
        max_gaussians: the budget of a pilot that has no budget of its own.
    """

    scene: Scene
    validation: list[View]
    max_gaussians: int


class ScenePilots:
    """Runs pilots of one scene and keeps their scores.

    Attributes:
        scene, config, cache: as given.
        scores: of all pilots so far.
        steps: that all pilots have taken so far.
    """

    def __init__(
        self,
        scene: Scene,
        config: TrainConfig,
        cache: PictureCache,
        device: torch.device,
        report: Report = lambda step, loss, mse, gaussians: None,
        stop: Callable[[], bool] = lambda: False,
        phase: Phase = lambda what, done, total: None,
    ) -> None:
        """Start without any scores.

        Args:
            scene: whose training photos are used.
            config: of the run to come.
            cache: keeps photos that are decoded.
            report: called after each step with its number among those of all pilots, the loss and mean squared error
                of its view, and the number of Gaussians.
            stop: called after each step; True ends the pilots.
            phase: called with what is being done, and how many of how many steps, photos or views are done.
        """
        self.scene, self.config, self.cache = scene, config, cache
        self._device, self._report, self._stop, self._phase = device, report, stop, phase
        self.scores: list[PilotScore] = []
        self.steps = 0

    def fold(self, every: int | None = None, max_validation: int = MAX_VALIDATION_VIEWS, number: int = 0) -> Fold:
        """Split the training photos.

        Args:
            every, max_validation, number: see `split`.

        Raises:
            HyrfError: a photo cannot be read.
        """
        training, views = split(self.scene.train, every, max_validation, number)
        validation: list[View] = []
        for done, view in enumerate(views):
            self._phase("reading validation photos", done, len(views))
            if is_usable(self.cache.get(view)):
                validation.append(view)
        scene = dataclasses.replace(self.scene, train=training, test=[])
        return Fold(scene, validation, budget_for(scene, TrainConfig(steps=BUDGET_REFERENCE_STEPS))[0])

    def run(
        self, name: str, fold: Fold, steps: int, *, seed: int, exposure: bool, max_gaussians: int | None = None
    ) -> PilotScore:
        """Train a pilot and score it on the validation photos.

        Args:
            name: of the pilot, for progress ("budget pilot run 1/2").
            fold: photos to train on and validation photos.
            steps: of the run.
            seed, exposure, max_gaussians: replace those of the run to come; None for the fold's budget.

        Raises:
            PilotsStopped: `stop` said so.
            HyrfError: as `Trainer.run`.
        """
        max_gaussians = max_gaussians or fold.max_gaussians
        settings = dataclasses.replace(
            self.config,
            steps=steps,
            seed=seed,
            exposure=exposure,
            max_gaussians=max_gaussians,
            budget_factor=None,
            target_bytes=None,
        )
        self._phase(f"{name}: reading photos", 0, 0)
        trainer = Trainer(fold.scene, settings, self.cache, self._device)
        before = self.steps

        def report_step(trainer: Trainer, loss: float, mse: float) -> None:
            self.steps = before + trainer.step
            self._report(self.steps, loss, mse, len(trainer.model))
            self._phase(f"{name}: training", trainer.step, steps)

        trainer.run(report=report_step, stop=self._stop)
        if self._stop():
            raise PilotsStopped
        count = len(fold.validation)
        result: Evaluation = evaluate_model(
            trainer.model,
            fold.validation,
            report=lambda _, share: self._phase(f"{name}: scoring", round(share * count), count),
        )
        score = PilotScore(
            steps=steps,
            seed=seed,
            max_gaussians=max_gaussians,
            exposure=exposure,
            psnr=result.psnr,
            ssim=result.ssim,
            psnr_corrected=result.psnr_corrected,
            psnr_per_view=[view.psnr for view in result.views],
        )
        self.scores.append(score)
        return score


def is_usable(picture: Picture) -> bool:
    """Return whether the mask leaves any pixel of the picture."""
    return picture.mask is None or bool(picture.mask.any())


def split(
    views: Sequence[View], every: int | None = None, max_validation: int = MAX_VALIDATION_VIEWS, number: int = 0
) -> tuple[list[View], list[View]]:
    """Split photos into those that pilots train on and validation photos.

    Pilots train on the photos that do not validate; of many, on those next to a validation photo, because photos spread
    over a large set would show too little of each place.

    Args:
        every: one of so many photos validates; None for 8, or 5 of fewer than 16 photos.
        max_validation: the most validation photos.
        number: of the fold. Folds 0 to `every` - 1 have no validation photo in common.
    """
    every = every or (8 if len(views) >= 16 else 5)
    chosen = evenly_spaced(range((every // 2 + number) % every, len(views), every), max_validation)
    others = sorted(set(range(len(views))) - set(chosen), key=lambda n: min(abs(n - place) for place in chosen))
    return [views[n] for n in sorted(others[:MAX_TRAINING_VIEWS])], [views[n] for n in chosen]

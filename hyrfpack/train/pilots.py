"""Short training runs before the long one, scored on validation photos: the place where a scene decides what it needs.

Validation photos are taken from the training photos; held-out photos have no part in it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import torch

from hyrfpack.data import PictureCache
from hyrfpack.evaluate import Evaluation, evaluate
from hyrfpack.scene import Picture, Scene, View, evenly_spaced
from hyrfpack.train.config import TrainConfig
from hyrfpack.train.setup import budget_for
from hyrfpack.train.trainer import Trainer

BUDGET_REFERENCE_STEPS = 500  # a pilot has at most the Gaussians of a run of this length
MAX_TRAINING_VIEWS = 150  # as many as a pilot has steps at most
MAX_VALIDATION_VIEWS = 8
MIN_TRAINING_VIEWS = 8  # of fewer photos none can be spared

Report = Callable[[int, float, float, int], None]  # step, loss, mean squared error, Gaussians
Phase = Callable[[str, int, int], None]  # what is being done, items done, items in all (0: not known)


class PilotsStopped(Exception):
    """The run was asked to end while pilots ran."""


@dataclass(frozen=True)
class PilotScore:
    """What one pilot run came to on the validation photos.

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


class ScenePilots:
    """Runs pilots of one scene and remembers their scores.

    Attributes:
        validation: the photos that pilots are scored on; none where masks leave nothing of them.
        budget: Gaussians at most of a pilot, unless it is told otherwise.
        scores: of all pilots so far.
        steps: that pilots have taken so far.
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
        *,
        validation_every: int | None = None,
        max_validation: int = MAX_VALIDATION_VIEWS,
        steps_before: int = 0,
    ) -> None:
        """Choose the validation photos.

        Args:
            scene: whose training photos are used.
            config: of the run to come.
            cache: keeps photos that are decoded.
            report: told after each step its number among those of all pilots, the loss and mean squared error of its
                view, and how many Gaussians there are.
            stop: asked after each step.
            phase: told what is being done, and how many of how many steps, photos or views are done.
            validation_every, max_validation: see `split`.
            steps_before: that other pilots of the scene have taken, for `report`.

        Raises:
            HyrfError: a photo cannot be read.
        """
        training, validation = split(scene.train, validation_every, max_validation)
        self.config, self.cache = config, cache
        self._device, self._report, self._stop, self._phase = device, report, stop, phase
        self.validation: list[View] = []
        for done, view in enumerate(validation):
            phase("reading photos to score pilot runs on", done, len(validation))
            if is_usable(cache.get(view)):
                self.validation.append(view)
        self.scene = dataclasses.replace(scene, train=training, test=[])
        self.budget, _ = budget_for(self.scene, TrainConfig(steps=BUDGET_REFERENCE_STEPS))
        self.scores: list[PilotScore] = []
        self.steps = steps_before

    def run(self, name: str, steps: int, *, seed: int, exposure: bool, max_gaussians: int | None = None) -> PilotScore:
        """Train a pilot and score it on the validation photos.

        Args:
            name: of the pilot, for progress ("pilot run 1 of 2").
            steps: of the run.
            seed, exposure, max_gaussians: replace those of the run to come; None for `budget`.

        Raises:
            PilotsStopped: `stop` said so.
            HyrfError: as `Trainer.run`.
        """
        settings = dataclasses.replace(
            self.config,
            steps=steps,
            seed=seed,
            exposure=exposure,
            max_gaussians=max_gaussians or self.budget,
            budget_factor=None,
            target_bytes=None,
        )
        self._phase(f"{name}: reading photos", 0, 0)
        trainer = Trainer(self.scene, settings, self.cache, self._device)
        before = self.steps

        def tell(trainer: Trainer, loss: float, mse: float) -> None:
            self.steps = before + trainer.step
            self._report(self.steps, loss, mse, len(trainer.model))
            self._phase(f"{name}: training", trainer.step, steps)

        trainer.run(report=tell, stop=self._stop)
        if self._stop():
            raise PilotsStopped
        count = len(self.validation)
        result: Evaluation = evaluate(
            trainer.model,
            self.validation,
            report=lambda _, share: self._phase(f"{name}: scoring", round(share * count), count),
        )
        score = PilotScore(
            steps=steps,
            seed=seed,
            max_gaussians=max_gaussians or self.budget,
            exposure=exposure,
            psnr=result.psnr,
            ssim=result.ssim,
            psnr_corrected=result.psnr_corrected,
            psnr_per_view=[view.psnr for view in result.views],
        )
        self.scores.append(score)
        return score


def is_usable(picture: Picture) -> bool:
    """Whether its mask leaves anything of it."""
    return picture.mask is None or bool(picture.mask.any())


def split(
    views: Sequence[View], every: int | None = None, most: int = MAX_VALIDATION_VIEWS
) -> tuple[list[View], list[View]]:
    """Photos to train pilots on and validation photos.

    The rest is trained on; of many photos those that are nearest to a validation photo, for spread over a large set
    they would show too little of each place.

    Args:
        every: one of so many photos validates; None for 8, or 5 where there are few.
        most: validation photos.
    """
    every = every or (8 if len(views) >= 16 else 5)
    chosen = evenly_spaced(range(every // 2, len(views), every), most)
    others = sorted(set(range(len(views))) - set(chosen), key=lambda n: min(abs(n - place) for place in chosen))
    return [views[n] for n in sorted(others[:MAX_TRAINING_VIEWS])], [views[n] for n in chosen]

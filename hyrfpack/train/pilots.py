"""How many Gaussians a scene is worth, told by two short runs before the long one.

Where n Gaussians score a + g log2(n) dB on photos that were not trained on, and each costs the same, the best number of
them is in proportion to g: a plain scene is worth a fraction of what one full of detail is, however many pixels its
photos have. Two pilots, of a quarter of a small budget and of all of it, measure g; another two where it is small.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from statistics import fmean

import torch

from hyrfpack.data import PictureCache
from hyrfpack.evaluate import evaluate
from hyrfpack.scene import Picture, Scene, View, evenly_spaced
from hyrfpack.train.config import TrainConfig
from hyrfpack.train.setup import budget_for
from hyrfpack.train.trainer import Trainer

LEAST_STEPS = 2_000  # of a run that pilots take little of
PILOT_STEPS = 120  # of each
ROUNDS = 2  # of two pilots, at most
MOST_STEPS = 2 * ROUNDS * PILOT_STEPS
BUDGET_STEPS = 500  # the whole budget of a pilot is that of a run of so many steps
SMALL = 0.25  # of it has the small pilot
EXPECTED = 0.6  # dB between them where pixels and steps decide rightly
# Times that many, in steps so wide because another seed moves the gain by up to 0.3 dB.
FACTORS = (0.25, 0.35, 0.5, 0.7, 1.0, 1.5)
FEWEST_PHOTOS = 8  # to train on; of fewer none can be spared
JUDGES = 8  # photos at most that pilots are scored on


def is_usable(picture: Picture) -> bool:
    """Whether its mask leaves anything of it."""
    return picture.mask is None or bool(picture.mask.any())


def is_undecided(config: TrainConfig) -> bool:
    """Whether nobody has said how many Gaussians there shall be."""
    return config.budget_factor is None and config.max_gaussians is None and config.target_bytes is None


def measures_budget(scene: Scene, config: TrainConfig) -> bool:
    """Whether pilots are to tell the budget: nobody has said it, they take little of the run, and photos are enough."""
    return is_undecided(config) and config.steps >= LEAST_STEPS and len(scene.train) >= FEWEST_PHOTOS


def measure_budget(
    scene: Scene,
    config: TrainConfig,
    cache: PictureCache,
    device: torch.device,
    report: Callable[[int, float, float, int], None] = lambda step, loss, mse, gaussians: None,
    stop: Callable[[], bool] = lambda: False,
    phase: Callable[[str, int, int], None] = lambda what, done, total: None,
) -> tuple[float, str] | None:
    """Times the usual budget that a scene is worth, one of `FACTORS`, and why; None where it was stopped.

    Some of the training photos are held out, the pilots are trained on the others, and scored on them after an affine
    correction of colours.

    Args:
        config: of the run to come.
        cache: keeps photos that are decoded.
        report: told after each of `MOST_STEPS` steps at most its number, the loss and mean squared error of its view,
            and how many Gaussians there are.
        stop: asked after each step.
        phase: told what is being done, and how many of how many steps, photos or views are done.

    Raises:
        HyrfError: as `Trainer.run`; a photo cannot be read.
    """
    near, judges = split(scene.train)
    usable = []
    for done, view in enumerate(judges):
        phase("reading photos to score pilot runs on", done, len(judges))
        if is_usable(cache.get(view)):
            usable.append(view)
    judges = usable
    if not judges:
        return 1.0, "masks leave nothing of the photos to judge by"
    scene = dataclasses.replace(scene, train=near, test=[])
    usual, _ = budget_for(scene, TrainConfig(steps=BUDGET_STEPS))
    few = round(SMALL * usual)
    gains: list[float] = []
    # What would make the model smaller is asked a second time, of another seed.
    while not gains or (len(gains) < ROUNDS and gains[0] < EXPECTED):
        scores: list[float] = []
        for budget in (few, usual):
            seed = config.seed ^ len(gains)
            settings = dataclasses.replace(config, steps=PILOT_STEPS, max_gaussians=budget, seed=seed)
            finished = 2 * len(gains) + len(scores)
            name, before = f"pilot run {finished + 1} of {2 * len(gains) + 2}", PILOT_STEPS * finished
            phase(f"{name}: reading photos", 0, 0)
            trainer = Trainer(scene, settings, cache, device)

            def tell(trainer: Trainer, loss: float, mse: float, before: int = before, name: str = name) -> None:
                report(before + trainer.step, loss, mse, len(trainer.model))
                phase(f"{name}: training", trainer.step, PILOT_STEPS)

            trainer.run(report=tell, stop=stop)
            if stop():
                return None

            def tell_scored(_: str, share: float, name: str = name) -> None:
                phase(f"{name}: scoring", round(share * len(judges)), len(judges))

            scores.append(evaluate(trainer.model, judges, report=tell_scored).psnr_corrected)
        gains.append(scores[1] - scores[0])
    gain = fmean(gains)
    worth = max(gain / EXPECTED, FACTORS[0])
    factor = min(FACTORS, key=lambda factor: abs(math.log(factor / worth)))
    return factor, f"in {PILOT_STEPS} steps {usual:,} Gaussians scored {gain:+.2f} dB over {few:,}"


def split(views: Sequence[View]) -> tuple[list[View], list[View]]:
    """Photos to train pilots on and to judge them by.

    One of every eight judges, or of every five where there are few, `JUDGES` at most. The rest is trained on; of many
    photos those that are nearest to a judge, as many as a pilot has steps, for spread over a large set they would show
    too little of each place.
    """
    every, first = (8, 4) if len(views) >= 16 else (5, 2)
    judges = evenly_spaced(range(first, len(views), every), JUDGES)
    others = sorted(set(range(len(views))) - set(judges), key=lambda n: min(abs(n - judge) for judge in judges))
    return [views[n] for n in sorted(others[:PILOT_STEPS])], [views[n] for n in judges]

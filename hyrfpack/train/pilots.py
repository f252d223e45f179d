"""How many Gaussians a scene is worth, told by two short runs before the long one.

Where n Gaussians score a + g log2(n) dB on photos that were not trained on, and each costs the same, the best number of
them is in proportion to g: an object before a plain wall is worth a fraction of what a cluttered room is, however
many pixels its photos have. Two pilots, of a quarter of a small budget and of all of it, measure g.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import torch

from hyrfpack.data import PictureCache
from hyrfpack.errors import HyrfError
from hyrfpack.evaluate import evaluate
from hyrfpack.scene import Scene, View, evenly_spaced
from hyrfpack.train.config import TrainConfig
from hyrfpack.train.setup import budget_for
from hyrfpack.train.trainer import Trainer

LEAST_STEPS = 2_000  # of a run that pilots take little of
PILOT_STEPS = 120
PILOTS_STEPS = 2 * PILOT_STEPS
BUDGET_STEPS = 500  # the whole budget of a pilot is that of a run of so many steps
SMALL = 0.25  # share of it that the small pilot has
EXPECTED = 0.6  # dB between them where pixels and steps decide rightly
LEAST, MOST = 0.25, 1.5  # times that many
FEWEST_PHOTOS = 8  # to train on; of fewer none can be spared
JUDGES = 8  # photos at most that pilots are scored on


def measures_share(scene: Scene, config: TrainConfig) -> bool:
    """Whether the share is to be measured: nobody has said how many Gaussians, and it takes little of the run."""
    asked = any(value is not None for value in (config.share, config.max_gaussians, config.target_bytes))
    return not asked and config.steps >= LEAST_STEPS and len(scene.train) >= FEWEST_PHOTOS


def measure_share(
    scene: Scene,
    config: TrainConfig,
    cache: PictureCache,
    device: torch.device,
    report: Callable[[int, float, float, int], None] = lambda step, loss, mse, gaussians: None,
) -> tuple[float, str]:
    """Times the usual budget that a scene is worth, `LEAST` to `MOST`, and why.

    Some of the training photos are held out, the pilots are trained on the others, and scored on them after an affine
    correction of colours.

    Args:
        config: of the run to come.
        cache: keeps photos that are decoded.
        report: told after each of `PILOTS_STEPS` steps its number, the loss and mean squared error of its view and how
            many Gaussians there are.

    Raises:
        HyrfError: as `Trainer.run`.
    """
    rest, judges = _split(scene.train)
    usual, _ = budget_for(scene, TrainConfig(steps=BUDGET_STEPS))
    scores: list[float] = []
    for share in (SMALL, 1.0):
        settings = dataclasses.replace(config, steps=PILOT_STEPS, max_gaussians=round(share * usual))
        trainer = Trainer(dataclasses.replace(scene, train=rest, test=[]), settings, cache, device)
        before = PILOT_STEPS * len(scores)
        trainer.run(report=lambda t, loss, mse, before=before: report(before + t.step, loss, mse, len(t.model)))
        try:
            scores.append(evaluate(trainer.model, judges).psnr_corrected)
        except HyrfError:  # masks leave nothing of them
            return 1.0, "not measured: masks leave nothing of the photos to judge by"
    gain = scores[1] - scores[0]
    share = min(max(round(gain / EXPECTED, 2), LEAST), MOST)
    return share, f"in {PILOT_STEPS} steps {usual:,} Gaussians scored {gain:+.2f} dB over {round(SMALL * usual):,}"


def _split(views: list[View]) -> tuple[list[View], list[View]]:
    """Photos to train on, and one of every eight, or of every five where there are few, to judge by."""
    every, place = (8, 4) if len(views) >= 16 else (5, 2)
    rest = [view for number, view in enumerate(views) if number % every != place]
    return evenly_spaced(rest, PILOT_STEPS), evenly_spaced(views[place::every], JUDGES)

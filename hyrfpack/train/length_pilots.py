"""Choose the number of steps of a long run on few photos, by complete pilot runs of increasing length.

Few photos do not determine a scene. A long run then fits its training photos better and better, while other views get
worse. Learning rates and density control follow the length of a run, so a checkpoint of a long run does not show what a
shorter run would give. Each pilot is therefore a complete run.
"""

from __future__ import annotations

import dataclasses

from hyrfpack.train.pilots import MIN_TRAINING_VIEWS, ScenePilots, quality_score
from hyrfpack.train.setup import budget_for

PILOT_LENGTHS_STEPS = (3_000, 10_000)
MIN_LENGTH_RATIO = 2  # The run is at least this many times as long as any shorter pilot.
# Pilots take as long as the run itself, so they pay only where a longer run is likely to overfit. With more training
# photos than FEW_PHOTOS, only runs that are MIN_LENGTH_RATIO times as long as the longest pilot are measured. With more
# than MAX_MEASURED_PHOTOS, none is.
FEW_PHOTOS = 30
MAX_MEASURED_PHOTOS = 100
LENGTH_VALIDATION_EVERY = 4  # One in this many training photos is a validation photo.


def pilot_lengths(steps: int) -> list[int]:
    """Return the numbers of steps that are compared for a run of `steps` steps; the last one is `steps`."""
    return [*(length for length in PILOT_LENGTHS_STEPS if MIN_LENGTH_RATIO * length <= steps), steps]


def max_length_pilot_steps(photos: int, steps: int) -> int:
    """Return the most steps that the pilots take before a run of `steps` steps on `photos` photos; 0 without pilots."""
    if not MIN_TRAINING_VIEWS <= photos <= MAX_MEASURED_PHOTOS:
        return 0
    shortest = MIN_LENGTH_RATIO * PILOT_LENGTHS_STEPS[0 if photos <= FEW_PHOTOS else -1]
    return sum(pilot_lengths(steps)) * (steps >= shortest)


def measure_length(pilots: ScenePilots, exposure: bool, budget_factor: float | None) -> tuple[int, str]:
    """Measure how many steps of training make the best renders of photos that were not trained on.

    Pilots of all `pilot_lengths` are trained on one fold, the shortest first, until one scores no higher on the
    validation photos than the one before it. That earlier length is chosen, or the full one if every pilot scores
    higher than the one before. The score is the `quality_score` of mean plain PSNR and mean SSIM. Each pilot has the
    Gaussian budget of a run of its length.

    Args:
        pilots: runs the pilots of the scene.
        exposure: whether the pilots learn per-image gains.
        budget_factor: multiple of the usual budget, see `TrainConfig`.

    Returns:
        The number of steps and the reason in words.

    Raises:
        TrainingStopped, HyrfError: as `ScenePilots.run`.
    """
    lengths = pilot_lengths(pilots.config.steps)
    fold = pilots.fold(LENGTH_VALIDATION_EVERY)
    if not fold.validation:
        return lengths[-1], f"{lengths[-1]:,}: masks leave no pixel of the validation photos"
    scores: list[float] = []
    measured: list[str] = []
    for number, length in enumerate(lengths, 1):
        config = dataclasses.replace(pilots.config, steps=length, budget_factor=budget_factor)
        pilot = pilots.run(
            f"length pilot run {number}/{len(lengths)}",
            fold,
            length,
            seed=config.seed,
            exposure=exposure,
            max_gaussians=budget_for(fold.scene, config)[0],
        )
        scores.append(quality_score(pilot.psnr, pilot.ssim))
        measured.append(f"{length:,} steps {pilot.psnr:.2f} dB, {pilot.ssim:.3f}")
        if len(scores) > 1 and scores[-1] <= scores[-2]:
            break
    chosen = lengths[scores.index(max(scores))]
    return chosen, f"{chosen:,}: {'; '.join(measured)} (plain PSNR, SSIM) on {len(fold.validation)} validation photos"

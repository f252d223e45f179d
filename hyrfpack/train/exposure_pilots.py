"""Decide whether a scene's per-image gains are learnt, by plain PSNR of pilot runs with and without them.

Neither the spread of the photos' exposures nor the leave-one-out error of the exposure map can decide. Glossy surfaces
and a small number of points look like differences in exposure. Pilot runs measure what a viewer would see.
"""

from __future__ import annotations

import numpy as np

from hyrfpack.train.exposure import describe_exposure_spread, estimate_exposure_spread
from hyrfpack.train.pilots import ScenePilots, count_folds

# Each pilot takes this share of the run's steps, within limits. Short pilots underestimate the gain of long runs, by up
# to 3.9 dB with 12 photos. The longer a model without gains trains, the more its view-dependent colours fit each
# photo's exposure.
EXPOSURE_PILOT_SHARE = 1 / 6
MIN_EXPOSURE_PILOT_STEPS = 150
MAX_EXPOSURE_PILOT_STEPS = 500
# Pilots train on photos of half the width and height and on a quarter of the Gaussians, in a third of the time. If the
# shorter side of any photo is below the limit, none is reduced.
EXPOSURE_PILOT_REDUCTION = 2
MIN_REDUCED_PILOT_SIDE_PIXELS = 128
# One in this many training photos is a validation photo. Other decisions need fewer validation photos: here the
# predicted exposure of a single photo has a large error.
EXPOSURE_VALIDATION_EVERY = 4
MAX_EXPOSURE_VALIDATION_VIEWS_PER_FOLD = 16
MIN_EXPOSURE_VALIDATION_VIEWS = 6  # With fewer in all folds, the safe default is kept.
MIN_EXPOSURE_ROUNDS = 2
MIN_EXPOSURE_SPREAD_STOPS = 0.05  # Photos whose exposures have a smaller standard deviation need no gains.
# Where the photos' exposures have at least this standard deviation, complete runs scored higher with gains, even if
# pilots did not. So gains are learnt unless pilots lose more than MAX_EXPOSURE_LOSS_DB.
LARGE_EXPOSURE_SPREAD_STOPS = 0.2
MAX_EXPOSURE_LOSS_DB = 0.1
# Where photos differ less, because of gloss or few points, say, pilots must gain this much, and at least this many
# standard errors over the validation photos. A limit of 1 would reject sets whose long runs gain 0.8 dB.
MIN_EXPOSURE_GAIN_DB = 0.1
MIN_GAIN_STANDARD_ERRORS = 0.5
CLEAR_GAIN_STANDARD_ERRORS = 2.0  # A gain this many standard errors from the limit needs no further round.
# Each photo's gain is clipped to this magnitude, so that a photo of unpredictable exposure cannot decide alone.
MAX_VIEW_GAIN_DB = 3.0


def exposure_pilot_steps(steps: int) -> int:
    """Return the number of steps of each pilot before a run of `steps` steps."""
    return min(max(round(EXPOSURE_PILOT_SHARE * steps), MIN_EXPOSURE_PILOT_STEPS), MAX_EXPOSURE_PILOT_STEPS)


def exposure_rounds(count: int) -> int:
    """Return the largest number of rounds of two pilots that a scene needs.

    Each round has another seed and another fold, so that scenes of few photos take more rounds. Masks and photos of one
    position may take further ones.

    Args:
        count: number of training photos.
    """
    views_per_fold = max(1, count // EXPOSURE_VALIDATION_EVERY)
    enough = -(-MIN_EXPOSURE_VALIDATION_VIEWS // views_per_fold)
    return min(max(enough, MIN_EXPOSURE_ROUNDS), EXPOSURE_VALIDATION_EVERY)


def measure_exposure(pilots: ScenePilots) -> tuple[bool, str]:
    """Measure whether learning per-image gains makes renders more like photos that were not trained on.

    Each round trains a pilot with gains and one without on the same fold. The decision depends on the mean gain in
    plain PSNR over the validation photos of all rounds. Where the photos' exposures differ by
    `LARGE_EXPOSURE_SPREAD_STOPS`, per-image gains are learnt unless the pilots lose more than `MAX_EXPOSURE_LOSS_DB`.
    Elsewhere they are learnt if the pilots gain at least `MIN_EXPOSURE_GAIN_DB` and at least `MIN_GAIN_STANDARD_ERRORS`
    times the standard error. The rounds end early if the mean gain is clear, or not positive where the photos differ
    little, and go on to all folds while there are fewer than `MIN_EXPOSURE_VALIDATION_VIEWS` photos to score. If masks
    leave fewer in all folds, no gains are learnt, which is the safe default.

    Returns:
        Whether to learn per-image gains, and the reason in words.

    Raises:
        TrainingStopped, HyrfError: as `ScenePilots.run`; a photo cannot be read.
    """
    spread = estimate_exposure_spread(pilots.scene, pilots.cache)
    if spread is None or spread < MIN_EXPOSURE_SPREAD_STOPS:
        return False, describe_exposure_spread(spread)
    is_large = spread >= LARGE_EXPOSURE_SPREAD_STOPS
    limit = -MAX_EXPOSURE_LOSS_DB if is_large else MIN_EXPOSURE_GAIN_DB
    folds, steps = count_folds(pilots.scene.train, EXPOSURE_VALIDATION_EVERY), exposure_pilot_steps(pilots.config.steps)
    rounds = min(exposure_rounds(len(pilots.scene.train)), folds)
    gains: list[float] = []  # The PSNR gain of each validation photo in dB.
    for number in range(folds):
        if number >= rounds and len(gains) >= MIN_EXPOSURE_VALIDATION_VIEWS:
            break
        gains += _gain_per_view(pilots, number, max(rounds, number + 1), steps)
        if gains and not is_large and np.mean(gains) <= 0:
            break
        if len(gains) >= MIN_EXPOSURE_VALIDATION_VIEWS:
            gain, error = _mean_and_standard_error(gains)
            if abs(gain - limit) >= CLEAR_GAIN_STANDARD_ERRORS * error:
                break
    is_loss = len(gains) > 1 and not is_large and np.mean(gains) <= 0
    if len(gains) < MIN_EXPOSURE_VALIDATION_VIEWS and not is_loss:
        return False, f"masks leave {len(gains)} of the validation photos, too few to measure whether gains help"
    gain, error = _mean_and_standard_error(gains)
    needed = limit if is_large else max(limit, MIN_GAIN_STANDARD_ERRORS * error)
    return gain >= needed, (
        f"in {steps} steps gains and exposure map scored {gain:+.2f} dB of plain PSNR (standard error {error:.2f}) on "
        f"{len(gains)} validation photos; the limit is {needed:+.2f} dB"
    )


def _gain_per_view(pilots: ScenePilots, number: int, rounds: int, steps: int) -> list[float]:
    """Return the PSNR gain of each validation photo in round `number` (from 0), dB, clipped to +-`MAX_VIEW_GAIN_DB`.

    The list is empty if masks leave no validation photo.
    """
    sides = [min(view.camera.width, view.camera.height) for view in pilots.scene.train]
    reduction = EXPOSURE_PILOT_REDUCTION if min(sides) >= MIN_REDUCED_PILOT_SIDE_PIXELS else 1
    fold = pilots.fold(EXPOSURE_VALIDATION_EVERY, MAX_EXPOSURE_VALIDATION_VIEWS_PER_FOLD, number, reduction)
    if not fold.validation:
        return []
    without, compensated = (
        pilots.run(
            f"exposure pilot run {2 * number + position}/{2 * rounds}",
            fold,
            steps,
            seed=pilots.config.seed ^ number,
            exposure=exposure,
        ).psnr_per_view
        for position, exposure in enumerate((False, True), 1)
    )
    return np.clip(np.subtract(compensated, without), -MAX_VIEW_GAIN_DB, MAX_VIEW_GAIN_DB).tolist()


def _mean_and_standard_error(values: list[float]) -> tuple[float, float]:
    """Return the mean of two or more values, and its standard error."""
    return float(np.mean(values)), float(np.std(values, ddof=1) / np.sqrt(len(values)))

"""Decide whether a scene's per-image gains are learnt, by plain PSNR of pilot runs with and without them.

Neither the spread of the photos' exposures nor the leave-one-out error of the exposure map can decide: gloss and few
points look like exposure. Pilot runs measure what a viewer would see.
"""

from __future__ import annotations

import numpy as np

from hyrfpack.train.exposure import exposure_spread
from hyrfpack.train.pilots import ScenePilots

# Each pilot takes this share of the run's steps, within limits. Short pilots underestimate the gain of long runs, by up
# to 3.9 dB with 12 photos: the longer a model without gains trains, the more it fits each photo's exposure by
# view-dependent colours.
EXPOSURE_PILOT_SHARE = 1 / 6
MIN_EXPOSURE_PILOT_STEPS = 150
MAX_EXPOSURE_PILOT_STEPS = 500
# Of so many training photos, one validates. The other decisions need fewer validation photos, because the predicted
# exposure of a single photo has a large error.
EXPOSURE_VALIDATION_EVERY = 4
MAX_EXPOSURE_VALIDATION_VIEWS = 16  # in one fold
MIN_EXPOSURE_VALIDATION_VIEWS = 6  # in all folds together, for any decision but the safe default
MIN_EXPOSURE_ROUNDS = 2
MIN_EXPOSURE_SPREAD_STOPS = 0.05  # Photos whose exposures have a smaller standard deviation need no gains.
MIN_EXPOSURE_GAIN_DB = 0.1
# A gain must also be so many times its standard error over the validation photos. One would reject sets whose long runs
# gain 0.8 dB, because long runs gain more than pilots.
MIN_GAIN_STANDARD_ERRORS = 0.5
CLEAR_GAIN_STANDARD_ERRORS = 2.0  # A gain of so many needs no further round.
# The gain of one photo counts no more, either way, so that a photo of unpredictable exposure cannot decide alone.
MAX_VIEW_GAIN_DB = 3.0


def exposure_pilot_steps(steps: int) -> int:
    """Return the steps of each pilot before a run of `steps` steps."""
    return min(max(round(EXPOSURE_PILOT_SHARE * steps), MIN_EXPOSURE_PILOT_STEPS), MAX_EXPOSURE_PILOT_STEPS)


def exposure_rounds(count: int) -> int:
    """Return how many rounds of two pilots a scene needs at most.

    Each round has another seed and another fold, so that few photos take more rounds.

    Args:
        count: of training photos.
    """
    views_per_fold = max(1, count // EXPOSURE_VALIDATION_EVERY)
    enough = -(-MIN_EXPOSURE_VALIDATION_VIEWS // views_per_fold)
    return min(max(enough, MIN_EXPOSURE_ROUNDS), EXPOSURE_VALIDATION_EVERY)


def measure_exposure(pilots: ScenePilots) -> tuple[bool, str]:
    """Measure whether learning per-image gains makes renders more like photos that were not trained on.

    Each round trains a pilot with gains and one without on the same fold. Gains are learnt where the mean gain in plain
    PSNR over the validation photos of all rounds is at least `MIN_EXPOSURE_GAIN_DB` and at least
    `MIN_GAIN_STANDARD_ERRORS` times its standard error. Otherwise, or if masks leave fewer than
    `MIN_EXPOSURE_VALIDATION_VIEWS` photos to score, the safe default stands: no gains. The rounds end early if the mean
    gain is clear or not positive. The gain of each photo counts up to `MAX_VIEW_GAIN_DB` either way.

    Returns:
        Whether gains are to be learnt, and the reason in words.

    Raises:
        PilotsStopped, HyrfError: as `ScenePilots.run`; a photo cannot be read.
    """
    spread = exposure_spread(pilots.scene, pilots.cache)
    if spread < MIN_EXPOSURE_SPREAD_STOPS:
        return False, f"by their tracks the photos differ by {spread:.2f} stops"
    rounds, steps = exposure_rounds(len(pilots.scene.train)), exposure_pilot_steps(pilots.config.steps)
    gains: list[float] = []  # of each validation photo, dB
    for number in range(rounds):
        gains += _gain_per_view(pilots, number, rounds, steps)
        if gains and np.mean(gains) <= 0:
            break
        if len(gains) >= MIN_EXPOSURE_VALIDATION_VIEWS:
            gain, error = _mean_and_standard_error(gains)
            if gain >= CLEAR_GAIN_STANDARD_ERRORS * error:
                break
    if len(gains) < 2:
        return False, f"masks leave {len(gains)} of the validation photos, too few to measure whether gains help"
    gain, error = _mean_and_standard_error(gains)
    has_enough_photos = len(gains) >= MIN_EXPOSURE_VALIDATION_VIEWS
    return has_enough_photos and gain >= max(MIN_EXPOSURE_GAIN_DB, MIN_GAIN_STANDARD_ERRORS * error), (
        f"in {steps} steps gains and exposure map scored {gain:+.2f} dB of plain PSNR (standard error {error:.2f}) on "
        f"{len(gains)} validation photos"
    )


def _gain_per_view(pilots: ScenePilots, number: int, rounds: int, steps: int) -> list[float]:
    """Return what gains bring to each validation photo in round `number` of `rounds`, dB, limited either way.

    The list is empty if masks leave no validation photo.
    """
    fold = pilots.fold(EXPOSURE_VALIDATION_EVERY, MAX_EXPOSURE_VALIDATION_VIEWS, number)
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
    """Return the mean of two values or more, and its standard error."""
    return float(np.mean(values)), float(np.std(values, ddof=1) / np.sqrt(len(values)))

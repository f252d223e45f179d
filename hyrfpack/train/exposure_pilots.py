"""Decide whether a scene's per-image gains are learnt, by plain PSNR of pilot runs with and without them.

A spread of exposures among the photos, and how well the exposure map predicts photos that it has not seen, do not tell:
gloss and few points look like exposure. What a viewer would see does.
"""

from __future__ import annotations

import numpy as np

from hyrfpack.train.exposure import exposure_spread
from hyrfpack.train.pilots import ScenePilots

EXPOSURE_PILOT_STEPS = 150  # of each pilot
EXPOSURE_VALIDATION_EVERY = 4  # one of so many training photos validates: predictions of single photos vary much
MAX_EXPOSURE_VALIDATION_VIEWS = 16
MIN_EXPOSURE_VALIDATION_VIEWS = 5
MAX_EXPOSURE_ROUNDS = 2  # of two pilots: one with gains, one without
MIN_EXPOSURE_SPREAD_STOPS = 0.05  # standard deviation; photos that differ less need no gains
MIN_EXPOSURE_GAIN_DB = 0.1  # in the mean of the rounds
MAX_VIEW_GAIN_DB = 3.0  # counts of one photo, either way: one whose exposure nothing predicts does not decide alone


def measure_exposure(pilots: ScenePilots) -> tuple[bool, str]:
    """Measure whether learning per-image gains makes renders more like photos that were not trained on.

    They are learnt where the gain in plain PSNR is at least `MIN_EXPOSURE_GAIN_DB`, no less than its standard error
    over the validation photos, and positive with each of two seeds. Otherwise the safe default stands: no gains. The
    gain of each photo counts up to `MAX_VIEW_GAIN_DB` either way.

    Returns:
        Whether gains are to be learnt, and the reason in words.

    Raises:
        PilotsStopped, HyrfError: as `ScenePilots.run`; a photo cannot be read.
    """
    count = len(pilots.validation)
    if count < MIN_EXPOSURE_VALIDATION_VIEWS:
        return False, f"{count} validation photos are too few to tell whether per-image gains help"
    spread = exposure_spread(pilots.scene, pilots.cache)
    if spread < MIN_EXPOSURE_SPREAD_STOPS:
        return False, f"by their tracks the photos differ by {spread:.2f} stops"
    rounds: list[np.ndarray] = []  # gain of each validation photo, dB
    while len(rounds) < MAX_EXPOSURE_ROUNDS and all(gains.mean() > 0 for gains in rounds):
        seed, before = pilots.config.seed ^ len(rounds), 2 * len(rounds)
        without, compensated = (
            np.array(
                pilots.run(
                    f"pilot run {before + number} of {before + 2} for exposure",
                    EXPOSURE_PILOT_STEPS,
                    seed=seed,
                    exposure=exposure,
                ).psnr_per_view
            )
            for number, exposure in enumerate((False, True), 1)
        )
        rounds.append(np.clip(compensated - without, -MAX_VIEW_GAIN_DB, MAX_VIEW_GAIN_DB))
    per_view = np.mean(rounds, 0)
    gain, error = float(per_view.mean()), float(per_view.std(ddof=1) / np.sqrt(count))
    is_better = all(gains.mean() > 0 for gains in rounds) and gain >= max(MIN_EXPOSURE_GAIN_DB, error)
    return is_better, (
        f"in {EXPOSURE_PILOT_STEPS} steps gains and exposure map scored {gain:+.2f} dB of plain PSNR (standard error "
        f"{error:.2f}) on {count} validation photos"
    )

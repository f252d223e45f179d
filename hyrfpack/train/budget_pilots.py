"""Measure how many Gaussians a scene is worth, by pilot runs with a small and a usual budget.

Where n Gaussians score a + g log2(n) dB on photos that were not trained on, and each costs the same, the best number of
them is in proportion to g: a plain scene is worth a fraction of what one full of detail is, however many pixels its
photos have. Two pilots, of a quarter of a small budget and of all of it, measure g; another two where it is small.
"""

from __future__ import annotations

import math
from statistics import fmean

from hyrfpack.train.pilots import ScenePilots

BUDGET_PILOT_STEPS = 120  # of each pilot
MAX_BUDGET_ROUNDS = 2  # of two pilots
SMALL_PILOT_BUDGET_RATIO = 0.25
EXPECTED_GAIN_DB = 0.6  # between the two budgets, where pixels and steps decide rightly
# Multiples of the usual budget, in steps so wide because another seed moves the gain by up to 0.3 dB.
FACTORS = (0.25, 0.35, 0.5, 0.7, 1.0, 1.5)


def measure_budget(pilots: ScenePilots) -> tuple[float, str]:
    """Measure the budget that a scene is worth.

    Scores are taken after an affine correction of colours: they compare detail.

    Returns:
        The budget as a multiple of the usual one, one of `FACTORS`, and the reason in words.

    Raises:
        PilotsStopped, HyrfError: as `ScenePilots.run`.
    """
    if not pilots.validation:
        return 1.0, "masks leave nothing of the photos to judge by"
    usual, small = pilots.budget, round(SMALL_PILOT_BUDGET_RATIO * pilots.budget)
    gains: list[float] = []
    # What would make the model smaller is asked a second time, of another seed.
    while not gains or (len(gains) < MAX_BUDGET_ROUNDS and gains[0] < EXPECTED_GAIN_DB):
        seed, before = pilots.config.seed ^ len(gains), 2 * len(gains)
        scores = [
            pilots.run(
                f"pilot run {before + number} of {before + 2} for the budget",
                BUDGET_PILOT_STEPS,
                seed=seed,
                exposure=bool(pilots.config.exposure),
                max_gaussians=budget,
            ).psnr_corrected
            for number, budget in enumerate((small, usual), 1)
        ]
        gains.append(scores[1] - scores[0])
    gain = fmean(gains)
    worth = max(gain / EXPECTED_GAIN_DB, FACTORS[0])
    factor = min(FACTORS, key=lambda factor: abs(math.log(factor / worth)))
    return factor, f"in {BUDGET_PILOT_STEPS} steps {usual:,} Gaussians scored {gain:+.2f} dB over {small:,}"

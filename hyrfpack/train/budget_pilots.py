"""Estimate the Gaussian budget of a scene from pilot runs with a small and a usual budget.

Suppose that n Gaussians have the `quality_score` a + g log2(n) on validation photos, and that each Gaussian costs the
same. Then the best number of Gaussians is proportional to g. A plain scene needs fewer than a detailed one, even if its
photos have more pixels. Two pilots measure g, one with a quarter of the usual budget and one with the full one. If g is
small, two more pilots with another seed confirm it. Both start from the points of the scene alone, so that they differ
in the number of Gaussians and not in the number of points on surfaces.
"""

from __future__ import annotations

import math
from statistics import fmean

from hyrfpack.train.pilots import ScenePilots, quality_score

BUDGET_PILOT_STEPS = 120
MAX_BUDGET_ROUNDS = 2  # Each round runs two pilots.
SMALL_PILOT_BUDGET_RATIO = 0.25
EXPECTED_GAIN_DB = 1.8  # If the `quality_score` of the larger pilot is this much higher, the usual budget is right.
# Multiples of the usual budget. The steps are wide, because another seed changes the gain by up to 0.3 dB.
BUDGET_FACTORS = (0.25, 0.35, 0.5, 0.7, 1.0, 1.5)


def measure_budget(pilots: ScenePilots, exposure: bool) -> tuple[float, str]:
    """Estimate the Gaussian budget of a scene.

    The PSNR of the scores is computed after an affine correction of colours, so that it compares detail.

    Args:
        pilots: runs the pilots of the scene.
        exposure: whether the pilots learn per-image gains.

    Returns:
        The budget as a multiple of the usual one, one of `BUDGET_FACTORS`, and the reason in words.

    Raises:
        TrainingStopped, HyrfError: as `ScenePilots.run`.
    """
    fold = pilots.fold()
    if not fold.validation:
        return 1.0, "masks leave no pixel of the validation photos"
    usual, small = fold.max_gaussians, round(SMALL_PILOT_BUDGET_RATIO * fold.max_gaussians)
    gains: list[tuple[float, float]] = []  # PSNR in dB and SSIM that the larger pilot of a round has more
    # A second round confirms a gain that would make the budget smaller.
    while not gains or (len(gains) < MAX_BUDGET_ROUNDS and quality_score(*gains[0]) < EXPECTED_GAIN_DB):
        seed, before = pilots.config.seed ^ len(gains), 2 * len(gains)
        small_run, usual_run = (
            pilots.run(
                f"budget pilot run {before + number}/{before + 2}",
                fold,
                BUDGET_PILOT_STEPS,
                seed=seed,
                exposure=exposure,
                max_gaussians=budget,
                surface_points=False,
            )
            for number, budget in enumerate((small, usual), 1)
        )
        gains.append((usual_run.psnr_corrected - small_run.psnr_corrected, usual_run.ssim - small_run.ssim))
    psnr, ssim = (fmean(parts) for parts in zip(*gains, strict=True))
    relative_gain = max(quality_score(psnr, ssim) / EXPECTED_GAIN_DB, BUDGET_FACTORS[0])
    factor = min(BUDGET_FACTORS, key=lambda factor: abs(math.log(factor / relative_gain)))
    gain = f"{psnr:+.2f} dB and {ssim:+.3f} of SSIM"
    return factor, f"in {BUDGET_PILOT_STEPS} steps {usual:,} Gaussians scored {gain} over {small:,}"

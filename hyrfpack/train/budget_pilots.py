"""Estimate the Gaussian budget of a scene from pilot runs with a small and a usual budget.

Suppose that n Gaussians score a + g log2(n) on validation photos, in dB of PSNR plus `SSIM_WEIGHT_DB` times SSIM, and
that each Gaussian costs the same. Then the best number of Gaussians is proportional to g. A plain scene needs fewer
than a detailed one, even if its photos have more pixels. Two pilots measure g, one with a quarter of the usual budget
and one with the full one. If g is small, two more pilots with another seed confirm it. Both start from the points of
the scene alone, so that they differ in the number of Gaussians and not in the number of interpolated points.
"""

from __future__ import annotations

import math
from statistics import fmean

from hyrfpack.train.pilots import SSIM_WEIGHT_DB, ScenePilots

BUDGET_PILOT_STEPS = 120
MAX_BUDGET_ROUNDS = 2  # Each round runs two pilots.
SMALL_PILOT_BUDGET_RATIO = 0.25
EXPECTED_GAIN_DB = 1.8  # If the larger pilot scores this much more, the usual budget is right. SSIM counts, too.
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
        PilotsStopped, HyrfError: as `ScenePilots.run`.
    """
    fold = pilots.fold()
    if not fold.validation:
        return 1.0, "masks leave no pixel of the validation photos"
    usual, small = fold.max_gaussians, round(SMALL_PILOT_BUDGET_RATIO * fold.max_gaussians)
    gains, psnr_gains, ssim_gains = list[float](), list[float](), list[float]()
    # A second round confirms a gain that would make the budget smaller.
    while not gains or (len(gains) < MAX_BUDGET_ROUNDS and gains[0] < EXPECTED_GAIN_DB):
        seed, before = pilots.config.seed ^ len(gains), 2 * len(gains)
        small_run, usual_run = (
            pilots.run(
                f"budget pilot run {before + number}/{before + 2}",
                fold,
                BUDGET_PILOT_STEPS,
                seed=seed,
                exposure=exposure,
                max_gaussians=budget,
                interpolate_points=False,
            )
            for number, budget in enumerate((small, usual), 1)
        )
        psnr_gains.append(usual_run.psnr_corrected - small_run.psnr_corrected)
        ssim_gains.append(usual_run.ssim - small_run.ssim)
        gains.append(psnr_gains[-1] + SSIM_WEIGHT_DB * ssim_gains[-1])
    gain = fmean(gains)
    relative_gain = max(gain / EXPECTED_GAIN_DB, BUDGET_FACTORS[0])
    factor = min(BUDGET_FACTORS, key=lambda factor: abs(math.log(factor / relative_gain)))
    return factor, (
        f"in {BUDGET_PILOT_STEPS} steps {usual:,} Gaussians scored {fmean(psnr_gains):+.2f} dB and "
        f"{fmean(ssim_gains):+.3f} of SSIM over {small:,}"
    )

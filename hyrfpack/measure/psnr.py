"""PSNR of a mean squared error, and the reverse."""

from __future__ import annotations

from typing import Any

# PSNR in dB of two identical pictures, for which the formula gives infinity; also the upper limit of other PSNRs.
IDENTICAL_PSNR = 100.0


def psnr_from_mse(mse: float) -> float:
    """Convert a mean squared error of colours in [0, 1] to PSNR in dB, at most `IDENTICAL_PSNR`; NaN stays NaN.

    PSNR = -10 log10(mse)
    """
    import numpy as np  # not at the top, because the command line imports the displays of progress, which import this

    return IDENTICAL_PSNR if mse == 0 else min(float(-10 * np.log10(mse)), IDENTICAL_PSNR)


def mse_from_psnr(psnr: Any) -> Any:
    """Convert PSNRs in dB, a number or an array, to mean squared errors of colours in [0, 1]."""
    return 10 ** (-psnr / 10)

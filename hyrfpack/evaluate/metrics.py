"""How near a rendered picture is to a photo: PSNR and SSIM, on 8-bit values, with masks."""

from __future__ import annotations

import math

import numpy as np
from torch import Tensor

from hyrfpack.ops.ssim import photometric_loss

IDENTICAL_PSNR = 100.0  # dB, what two pictures without any difference score (the formula says infinity)
ASSUMED_PSNR = 30.0  # dB, of a model that does not say how well it fits its photos


def to_8bit(image: Tensor) -> Tensor:
    """Clamp to [0, 1] and round to the 256 levels of a saved picture, still float32 in [0, 1].

    Renders are scored after this, so that a score is what anyone measures on the PNG files.
    """
    return (image.detach().float().clamp(0, 1) * 255).round() / 255


def psnr(image: Tensor, reference: Tensor, mask: Tensor | None = None) -> float:
    """Peak signal-to-noise ratio in dB, the squared error pooled over all counted pixels and channels.

        PSNR = -10 log10(mean((image - reference)^2))

    Args:
        image, reference: (H, W, 3) in [0, 1].
        mask: (H, W) bool, True where a pixel counts; all when None. At least one must.

    Returns:
        dB; `IDENTICAL_PSNR` at most.
    """
    squares = (image.double() - reference.double()) ** 2
    return decibels(float(squares.mean() if mask is None else squares[mask].mean()))


def decibels(mse: float) -> float:
    """The PSNR of a mean squared error of colours in [0, 1]: dB, `IDENTICAL_PSNR` at most."""
    return min(float(-10 * np.log10(mse)), IDENTICAL_PSNR) if mse > 0 else IDENTICAL_PSNR


def stated_error(provenance: dict) -> float:
    """Mean squared error of a model's pictures against its photos, by its file's own account.

    What packing or a format adds to it has nothing to do with it, so the two add up.

    Args:
        provenance: of the file; its `psnr` counts, or ASSUMED_PSNR where there is none that makes sense.
    """
    stated = provenance.get("psnr")
    if not isinstance(stated, int | float) or not 0 < stated < IDENTICAL_PSNR:
        stated = ASSUMED_PSNR
    return math.exp(-stated / 10 * math.log(10))


def ssim(image: Tensor, reference: Tensor, mask: Tensor | None = None) -> float:
    """Structural similarity: Gaussian window 11x11 with sigma 1.5, zeros around the picture, mean over channels.

    Pixels that do not count are set to the photo's on both sides, so that nothing rendered there leaks into the
    windows of their neighbours, and are left out of the mean.

    Args:
        image, reference: (H, W, 3) in [0, 1].
        mask: (H, W) bool, True where a pixel counts; all when None. At least one must.
    """
    return 1 - float(photometric_loss(image, reference, mask, ssim_weight=1.0))

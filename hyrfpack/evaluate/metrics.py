"""PSNR and SSIM of a rendered picture against a photo, on 8-bit values, with masks."""

from __future__ import annotations

import math
from collections.abc import Iterator

from torch import Tensor

from hyrfpack.measure.psnr import IDENTICAL_PSNR, psnr_from_mse
from hyrfpack.ops.ssim import photometric_loss

# PSNR in dB assumed for a model whose provenance does not state how well it fits its photos.
ASSUMED_PSNR_DB = 30.0
# Pictures are compared this many pixels at a time, because float64 copies of a whole photo of a phone take hundreds of
# megabytes.
MAX_PART_PIXELS = 65_536


def to_8bit(image: Tensor) -> Tensor:
    """Clamp a picture to [0, 1] and round it to the 256 levels of a saved one; the result is float32 in [0, 1].

    Renders are rounded before they are scored, so scores equal those measured on the saved PNG files.
    """
    return (image.detach().float().clamp(0, 1) * 255).round() / 255


def psnr(image: Tensor, reference: Tensor, mask: Tensor | None = None) -> float:
    """Return the peak signal-to-noise ratio in dB, with the squared error pooled over counted pixels and channels.

        PSNR = -10 log10(mean((image - reference)^2))

    Args:
        image, reference: (H, W, 3) in [0, 1].
        mask: (H, W) bool, True where a pixel counts, at least at one; None counts all pixels.

    Returns:
        PSNR in dB, at most `IDENTICAL_PSNR`.
    """
    total, count = 0.0, 0
    for rendered, target in iterate_counted_pixels(image, reference, mask):
        total += float((rendered - target).square().sum())
        count += rendered.numel()
    return psnr_from_mse(total / count)


def iterate_counted_pixels(image: Tensor, reference: Tensor, mask: Tensor | None) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield the pixels of two pictures that count, in parts.

    Args:
        image, reference, mask: as for `psnr`.

    Yields:
        (N, 3) float64 colours of the same pixels of both pictures, N at most MAX_PART_PIXELS.
    """
    flat, counted = [picture.reshape(-1, 3) for picture in (image, reference)], None if mask is None else mask.flatten()
    for start in range(0, len(flat[0]), MAX_PART_PIXELS):
        part = slice(start, start + MAX_PART_PIXELS)
        rendered, target = (colors[part] if counted is None else colors[part][counted[part]] for colors in flat)
        yield rendered.double(), target.double()


def provenance_mse(provenance: dict) -> float:
    """Return the mean squared error of a model against its photos, as stated in its file's provenance.

    The error that compression or a file format adds is independent of it, so the two errors add up.

    Args:
        provenance: provenance of the file. Its `psnr` is used, or ASSUMED_PSNR_DB if that is missing or out of range.
    """
    psnr_db = provenance.get("psnr")
    if isinstance(psnr_db, bool) or not isinstance(psnr_db, int | float) or not 0 < psnr_db < IDENTICAL_PSNR:
        psnr_db = ASSUMED_PSNR_DB
    return math.exp(-psnr_db / 10 * math.log(10))


def ssim(image: Tensor, reference: Tensor, mask: Tensor | None = None) -> float:
    """Return the structural similarity: Gaussian window 11x11, sigma 1.5, zero padding, mean over channels.

    Ignored pixels are left out of the mean. In both pictures they are set to the photo's values, so that the render
    there does not affect the windows of their neighbours.

    Args:
        image, reference: (H, W, 3) in [0, 1].
        mask: (H, W) bool, True where a pixel counts, at least at one; None counts all pixels.
    """
    return 1 - float(photometric_loss(image, reference, mask, ssim_weight=1.0))

"""Fits of a render's exposure and white balance to its photo: per-channel gains, and an affine colour correction."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

from hyrfpack.evaluate.metrics import MAX_PART_PIXELS, iterate_counted_pixels, to_8bit
from hyrfpack.model.exposure import apply_exposure_gains

# Gains are fitted to pixels that have every channel in this range, in the photo and in the render.
USABLE_RANGE = 4 / 255, 251 / 255
# Gains fitted to fewer pixels would be unreliable, so they are one.
MIN_PIXELS = 16
# Gains are clamped to [1 / MAX_GAIN, MAX_GAIN].
MAX_GAIN = 16.0
# Larger pictures are subsampled evenly to about this many pixels.
MAX_FITTED_PIXELS = 200_000
REWEIGHTING_ROUNDS = 10
# A pixel whose error is this many standard deviations has half the weight (Cauchy weights).
CAUCHY_SCALE_STDS = 2.385


def fit_gains(image: Tensor, photo: Tensor, mask: Tensor | None = None) -> np.ndarray:
    """Fit the gains of `apply_exposure_gains` that bring a render to the exposure and white balance of a photo.

        photo = apply_exposure_gains(image, g) + e

    The fit is iterated least squares over log g with the weights 1 / (1 + (e / 2.385 s)^2), for each channel. The
    standard deviation s of the errors e is estimated from their median, so errors of the render have little weight.
    Pixels that are nearly black or white in either picture are left out.

    Args:
        image, photo: (H, W, 3) in [0, 1].
        mask: (H, W) bool, True where a pixel counts; None counts all pixels.

    Returns:
        (3,) float64 in [1 / 16, 16]; ones if too few pixels are left.

    Raises:
        ValueError: a picture is not finite.

    Example:
        >>> photo = torch.rand(32, 32, 3)
        >>> fit_gains(photo, apply_exposure_gains(photo, torch.tensor([2.0, 1.0, 0.5]))).round(3)
        array([2. , 1. , 0.5])
    """
    low, high = USABLE_RANGE
    parts = []
    for rendered, target in _finite_pixels(image, photo, mask):
        usable = ((rendered >= low) & (rendered <= high) & (target >= low) & (target <= high)).all(1)
        parts.append((rendered[usable], target[usable]))
    rendered, target = (torch.cat(colors) for colors in zip(*parts, strict=True))
    if len(rendered) < MIN_PIXELS:
        return np.ones(3)
    stride = -(-len(rendered) // MAX_FITTED_PIXELS)
    rendered, target = rendered[::stride], target[::stride]
    weights = torch.ones_like(rendered)
    gains = torch.ones_like(rendered[0])
    for _ in range(REWEIGHTING_ROUNDS):
        # A Gauss-Newton step: the derivative of the exposed value y by log g is y (1 - y).
        exposed = apply_exposure_gains(rendered, gains)
        slopes, errors = exposed * (1 - exposed), target - exposed
        steps = (weights * slopes * errors).sum(0) / (weights * slopes.square()).sum(0)
        gains = (gains * steps.clamp(-1, 1).exp()).clamp(1 / MAX_GAIN, MAX_GAIN)
        errors = target - apply_exposure_gains(rendered, gains)
        spread = (1.4826 * errors.abs().median(0).values).clamp(min=1e-4)
        weights = 1 / (1 + (errors / (CAUCHY_SCALE_STDS * spread)).square())
    return gains.cpu().numpy()


def correct_colors(image: Tensor, photo: Tensor, mask: Tensor | None = None) -> Tensor:
    """Correct the colours of a render by the affine map (3 x 4) with the least squared error to its photo.

    This is the correction of NeRF in the Wild and RawNeRF. It uses the same photo that the render is scored against. If
    several maps have the least error, as for a picture of one colour, the one closest to the identity is used.

    Args:
        image, photo: (H, W, 3) in [0, 1].
        mask: (H, W) bool, True where a pixel counts, at least at one; None counts all pixels.

    Returns:
        (H, W, 3) in [0, 1], rounded to 8 bits.

    Raises:
        ValueError: a picture is not finite.

    Example:
        >>> photo = torch.rand(32, 32, 3)
        >>> torch.equal(correct_colors(0.5 * photo + 0.1, photo), to_8bit(photo))
        True
    """
    squares, products = np.zeros((4, 4)), np.zeros((4, 3))
    for rendered, target in _finite_pixels(image, photo, mask):
        inputs = torch.cat((rendered, torch.ones_like(rendered[:, :1])), 1)
        squares += (inputs.T @ inputs).cpu().numpy()
        products += (inputs.T @ (target - rendered)).cpu().numpy()
    affine = torch.from_numpy(np.linalg.pinv(squares, 1e-10, hermitian=True) @ products).to(image.device)
    corrected = [
        to_8bit(pixels + pixels @ affine[:3] + affine[3])
        for pixels in (part.double() for part in image.reshape(-1, 3).split(MAX_PART_PIXELS))
    ]
    return torch.cat(corrected).reshape(image.shape)


def _finite_pixels(image: Tensor, photo: Tensor, mask: Tensor | None) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield the parts of `iterate_counted_pixels`. Raises ValueError: a picture is not finite."""
    for rendered, target in iterate_counted_pixels(image, photo, mask):
        if not (rendered.isfinite().all() and target.isfinite().all()):
            raise ValueError("a picture to be compared is not finite")
        yield rendered, target

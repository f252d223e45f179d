"""Differences in exposure and white balance between a render and its photo: per-channel gains and affine correction."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from hyrfpack.evaluate.metrics import to_8bit
from hyrfpack.model.exposure import apply_exposure_gains

USABLE = 4 / 255, 251 / 255  # what every channel of a photo and of its render lies between where gains are fitted
LEAST = 16  # pixels; fewer tell nothing, and the gains are one
LARGEST = 16.0  # gain, and the inverse of the smallest
ENOUGH = 200_000  # pixels, spread over the picture
ROUNDS = 10  # of reweighting
CAUCHY = 2.385  # standard deviations at which a pixel counts half


def fitted_gains(image: Tensor, photo: Tensor, mask: Tensor | None = None) -> np.ndarray:
    """The gains of `apply_exposure_gains` that bring a render to the exposure and white balance of a photo.

        photo = apply_exposure_gains(image, g) + e

    by iterated least squares over log g with the weights 1 / (1 + (e / 2.385 s)^2), for each channel. s is the standard
    deviation of e, estimated from its median, so that errors of the render hardly count. Pixels that are nearly black
    or white in either image are left out.

    Args:
        image, photo: (H, W, 3) in [0, 1].
        mask: (H, W) bool, True where a pixel counts; all when None.

    Returns:
        (3,) float64 in [1 / 16, 16]; ones where hardly any pixel is left.

    Raises:
        ValueError: a picture is not finite.

    Example:
        >>> photo = torch.rand(32, 32, 3)
        >>> fitted_gains(photo, apply_exposure_gains(photo, torch.tensor([2.0, 1.0, 0.5]))).round(3)
        array([2. , 1. , 0.5])
    """
    rendered, wanted = _pixels(image, photo, mask)
    low, high = USABLE
    good = ((rendered >= low) & (rendered <= high) & (wanted >= low) & (wanted <= high)).all(1)
    rendered, wanted = rendered[good], wanted[good]
    if len(rendered) < LEAST:
        return np.ones(3)
    stride = -(-len(rendered) // ENOUGH)
    rendered, wanted = rendered[::stride], wanted[::stride]
    weights = torch.ones_like(rendered)
    gains = torch.ones_like(rendered[0])
    for _ in range(ROUNDS):  # of Gauss and Newton: the derivative by log g is y (1 - y)
        exposed = apply_exposure_gains(rendered, gains)
        slopes, errors = exposed * (1 - exposed), wanted - exposed
        steps = (weights * slopes * errors).sum(0) / (weights * slopes.square()).sum(0)
        gains = (gains * steps.clamp(-1, 1).exp()).clamp(1 / LARGEST, LARGEST)
        errors = wanted - apply_exposure_gains(rendered, gains)
        spread = (1.4826 * errors.abs().median(0).values).clamp(min=1e-4)
        weights = 1 / (1 + (errors / (CAUCHY * spread)).square())
    return gains.cpu().numpy()


def corrected(image: Tensor, photo: Tensor, mask: Tensor | None = None) -> Tensor:
    """A render in the colours of its photo: the affine map (3 x 4) of colours with the least squared error.

    That of NeRF in the Wild and RawNeRF, which looks at the very photo that the render is scored against. Of several
    maps as good, as for a picture of one colour, the one that is nearest to leaving the render as it is.

    Args:
        image, photo: (H, W, 3) in [0, 1].
        mask: (H, W) bool, True where a pixel counts; all when None. At least one must.

    Returns:
        (H, W, 3), clamped and of 8 bits.

    Raises:
        ValueError: a picture is not finite.

    Example:
        >>> photo = torch.rand(32, 32, 3)
        >>> torch.equal(corrected(0.5 * photo + 0.1, photo), to_8bit(photo))
        True
    """
    rendered, wanted = _pixels(image, photo, mask)
    ones = torch.ones_like(rendered[:, :1])
    known, missing = torch.cat((rendered, ones), 1), wanted - rendered
    change = np.linalg.pinv((known.T @ known).cpu().numpy(), 1e-10, hermitian=True) @ (known.T @ missing).cpu().numpy()
    affine = torch.from_numpy(change).to(image.device)
    whole = image.double()
    return to_8bit(whole + whole @ affine[:3] + affine[3])


def _pixels(image: Tensor, photo: Tensor, mask: Tensor | None) -> tuple[Tensor, Tensor]:
    """(N, 3) float64 colours of the pixels that count, of both pictures."""
    rendered, wanted = (
        (picture.reshape(-1, 3) if mask is None else picture[mask]).double() for picture in (image, photo)
    )
    if not (rendered.isfinite().all() and wanted.isfinite().all()):
        raise ValueError("a picture to be compared is not finite")
    return rendered, wanted

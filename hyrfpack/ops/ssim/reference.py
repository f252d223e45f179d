"""Implements SSIM and the photometric loss in plain torch for any device and dtype.

This reference defines the correct result.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

WINDOW_RADIUS = 5
WINDOW_SIGMA = 1.5
C1 = 0.01**2
C2 = 0.03**2


def window_weights() -> list[float]:
    """Return the 11 weights of the Gaussian window along one axis; they sum to 1."""
    taps = torch.arange(-WINDOW_RADIUS, WINDOW_RADIUS + 1, dtype=torch.float64)
    weights = torch.exp(-(taps**2) / (2 * WINDOW_SIGMA**2))
    return (weights / weights.sum()).tolist()


def _blur(planes: Tensor) -> Tensor:
    """Return the windowed mean around each pixel of (C, H, W); values outside the image count as 0."""
    weights = torch.tensor(window_weights(), dtype=planes.dtype, device=planes.device)
    planes = F.conv2d(planes[:, None], weights.view(1, 1, 1, -1), padding=(0, WINDOW_RADIUS))
    return F.conv2d(planes, weights.view(1, 1, -1, 1), padding=(WINDOW_RADIUS, 0))[:, 0]


def ssim_map(image: Tensor, reference: Tensor) -> Tensor:
    """Compute SSIM at each pixel and channel, (H, W, 3)."""
    x, y = image.permute(2, 0, 1), reference.permute(2, 0, 1)
    mean_x, mean_y = _blur(x), _blur(y)
    covariance = _blur(x * y) - mean_x * mean_y
    variances = _blur(x * x + y * y) - mean_x**2 - mean_y**2
    luminance = (2 * mean_x * mean_y + C1) / (mean_x**2 + mean_y**2 + C1)
    return (luminance * (2 * covariance + C2) / (variances + C2)).permute(1, 2, 0)


def ssim(image: Tensor, reference: Tensor) -> Tensor:
    """Compute `hyrfpack.ops.ssim.ssim` with torch operations that autograd differentiates."""
    return ssim_map(image, reference).mean()


def photometric_loss(image: Tensor, target: Tensor, mask: Tensor | None, ssim_weight: float) -> Tensor:
    """Compute `hyrfpack.ops.ssim.photometric_loss` with torch operations that autograd differentiates."""
    if mask is None:
        mask = torch.ones(image.shape[:2], dtype=torch.bool, device=image.device)
    image = torch.where(mask[..., None], image, target)
    count = (3 * mask.sum()).clamp(min=1)
    l1 = (image - target).abs().sum() / count
    dissimilarity = ((1 - ssim_map(image, target)) * mask[..., None]).sum() / count
    return (1 - ssim_weight) * l1 + ssim_weight * dissimilarity

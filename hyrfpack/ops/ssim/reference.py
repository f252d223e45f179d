"""SSIM and the photometric loss in plain torch, any device and dtype: the definition of right."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

RADIUS = 5
SIGMA = 1.5
C1 = 0.01**2
C2 = 0.03**2


def window() -> list[float]:
    """The 11 weights of the Gaussian window along one axis; they add up to 1."""
    taps = torch.arange(-RADIUS, RADIUS + 1, dtype=torch.float64)
    weights = torch.exp(-(taps**2) / (2 * SIGMA**2))
    return (weights / weights.sum()).tolist()


def _blur(planes: Tensor) -> Tensor:
    """Weighted mean around each pixel of (C, H, W); outside the picture is 0."""
    weights = torch.tensor(window(), dtype=planes.dtype, device=planes.device)
    planes = F.conv2d(planes[:, None], weights.view(1, 1, 1, -1), padding=(0, RADIUS))
    return F.conv2d(planes, weights.view(1, 1, -1, 1), padding=(RADIUS, 0))[:, 0]


def ssim_map(image: Tensor, reference: Tensor) -> Tensor:
    """SSIM at each pixel and channel, (H, W, 3)."""
    x, y = image.permute(2, 0, 1), reference.permute(2, 0, 1)
    mean_x, mean_y = _blur(x), _blur(y)
    covariance = _blur(x * y) - mean_x * mean_y
    variances = _blur(x * x + y * y) - mean_x**2 - mean_y**2
    luminance = (2 * mean_x * mean_y + C1) / (mean_x**2 + mean_y**2 + C1)
    return (luminance * (2 * covariance + C2) / (variances + C2)).permute(1, 2, 0)


def ssim(image: Tensor, reference: Tensor) -> Tensor:
    """As `hyrfpack.ops.ssim.ssim`, differentiable by autograd alone."""
    return ssim_map(image, reference).mean()


def photometric_loss(image: Tensor, target: Tensor, mask: Tensor | None, ssim_weight: float) -> Tensor:
    """As `hyrfpack.ops.ssim.photometric_loss`, differentiable by autograd alone."""
    if mask is None:
        mask = torch.ones(image.shape[:2], dtype=torch.bool, device=image.device)
    image = torch.where(mask[..., None], image, target)
    count = (3 * mask.sum()).clamp(min=1)
    l1 = (image - target).abs().sum() / count
    dissimilarity = ((1 - ssim_map(image, target)) * mask[..., None]).sum() / count
    return (1 - ssim_weight) * l1 + ssim_weight * dissimilarity

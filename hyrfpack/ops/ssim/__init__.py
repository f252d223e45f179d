"""Computes the structural similarity of two images and the photometric loss built on it."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from hyrfpack.ops.dispatch import choose_implementation
from hyrfpack.ops.ssim import reference as _reference

__all__ = ["photometric_loss", "ssim"]

_IMPLEMENTATIONS = ("reference", "cpu", "gpu")


def ssim(image: Tensor, reference: Tensor, *, implementation: str = "auto") -> Tensor:
    """Compute the mean structural similarity (Wang et al. 2004) of two images over all pixels and channels.

        SSIM = (2 m_x m_y + C1) (2 s_xy + C2) / ((m_x^2 + m_y^2 + C1) (s_x^2 + s_y^2 + C2))

    Local means m and (co)variances s are weighted by an 11x11 Gaussian window with sigma 1.5; C1 = 0.01^2,
    C2 = 0.03^2. Pixels outside the image count as black, as in 3D Gaussian splatting, so any image size is valid.

    Args:
        image, reference: (H, W, 3) in [0, 1], at least one pixel.
        implementation: "auto", "reference", "cpu" or "gpu" (the last two take float32 only).

    Returns:
        Scalar in [-1, 1]; 1 for equal images. Differentiable once, in `image` only.

    Raises:
        ValueError: shapes, dtypes or devices do not match.

    Example:
        >>> picture = torch.rand(16, 16, 3)
        >>> round(float(ssim(picture, picture)), 6)
        1.0
    """
    _check(image, reference, None)
    chosen = choose_implementation("photometric_loss", implementation, _IMPLEMENTATIONS, image, reference)
    if chosen == "reference":
        return _reference.ssim(image, reference.detach())
    loss = _GpuLoss if chosen == "gpu" else _CpuLoss
    return 1 - loss.apply(image, reference, None, 0.0, 1.0)


def photometric_loss(
    image: Tensor,
    target: Tensor,
    mask: Tensor | None = None,
    *,
    ssim_weight: float = 0.2,
    implementation: str = "auto",
) -> Tensor:
    """Compute the photometric loss between a rendered image and a photo.

        loss = (1 - w) mean |image - target| + w (1 - mean SSIM)

    Where the mask is False, `image` is replaced by `target` before SSIM is computed, so that windows of included
    pixels see no difference there. Both means exclude these pixels: they add neither to the loss nor to its gradient.

    Args:
        image, target: (H, W, 3) in [0, 1], at least one pixel.
        mask: (H, W) bool, True for pixels to include; None includes all.
        ssim_weight: w, in [0, 1].
        implementation: "auto", "reference", "cpu" or "gpu" (the last two take float32 only).

    Returns:
        Scalar; 0 if the images are equal or the mask includes no pixel. Differentiable once, in `image` only.

    Raises:
        ValueError: shapes, dtypes or devices do not match.

    Example:
        >>> photo = torch.zeros(16, 16, 3)
        >>> round(float(photometric_loss(photo + 0.5, photo, ssim_weight=0.0)), 6)
        0.5
    """
    _check(image, target, mask)
    chosen = choose_implementation("photometric_loss", implementation, _IMPLEMENTATIONS, image, target)
    if chosen == "reference":
        return _reference.photometric_loss(image, target.detach(), mask, ssim_weight)
    loss = _GpuLoss if chosen == "gpu" else _CpuLoss
    return loss.apply(image, target, mask, 1 - ssim_weight, ssim_weight)


def _check(image: Tensor, target: Tensor, mask: Tensor | None) -> None:
    """Raise ValueError unless the shapes match and the mask is bool."""
    if image.ndim != 3 or image.shape[2] != 3 or image.numel() == 0 or image.shape != target.shape:
        raise ValueError(f"pictures must be two equal (H, W, 3), not {tuple(image.shape)} and {tuple(target.shape)}")
    if mask is not None and (mask.shape != image.shape[:2] or mask.dtype != torch.bool):
        raise ValueError(f"mask must be bool {tuple(image.shape[:2])}, not {mask.dtype} {tuple(mask.shape)}")


class _CpuLoss(torch.autograd.Function):
    """Computes l1_weight * mean |image - target| + ssim_weight * (1 - mean SSIM) and its gradient in one pass."""

    @staticmethod
    def forward(
        ctx, image: Tensor, target: Tensor, mask: Tensor | None, l1_weight: float, ssim_weight: float
    ) -> Tensor:
        from hyrfpack.ops.ssim import cpu

        shape, count, weights = image.shape, image.numel(), None
        if mask is not None:
            count = max(1, 3 * int(mask.sum()))
            image = torch.where(mask[..., None], image, target)
            weights = mask[..., None].expand(shape).float().reshape(shape[0], -1).numpy()
        image_values, target_values = (
            picture.detach().reshape(shape[0], -1).contiguous().numpy() for picture in (image, target)
        )
        loss, gradient = cpu.loss_and_gradient(
            image_values, target_values, weights, l1_weight / count, ssim_weight / count, ctx.needs_input_grad[0]
        )
        if ctx.needs_input_grad[0]:
            ctx.save_for_backward(torch.from_numpy(gradient).view(shape))
        return image.new_tensor(loss)

    @staticmethod
    @once_differentiable
    def backward(ctx, grad: Tensor) -> tuple[Tensor | None, ...]:
        (gradient,) = ctx.saved_tensors
        return grad * gradient, None, None, None, None


class _GpuLoss(torch.autograd.Function):
    """Computes the loss of `_CpuLoss` on the GPU; the gradient is computed in the backward pass."""

    @staticmethod
    def forward(
        ctx, image: Tensor, target: Tensor, mask: Tensor | None, l1_weight: float, ssim_weight: float
    ) -> Tensor:
        from hyrfpack.ops.ssim import gpu

        image, target = image.contiguous(), target.contiguous()
        mask = None if mask is None else mask.contiguous()
        loss, derivatives, inverse_count = gpu.loss_and_derivatives(image, target, mask, l1_weight, ssim_weight)
        ctx.save_for_backward(image, target, mask, derivatives, inverse_count)
        ctx.weights = l1_weight, ssim_weight
        return loss

    @staticmethod
    @once_differentiable
    def backward(ctx, grad: Tensor) -> tuple[Tensor | None, ...]:
        from hyrfpack.ops.ssim import gpu

        (image, target, mask, derivatives, inverse_count), (l1, ssim) = ctx.saved_tensors, ctx.weights
        return gpu.gradient(image, target, mask, derivatives, inverse_count, l1, ssim, grad), None, None, None, None

"""A step of Adam in torch's fused kernel: the bits of torch.optim.Adam(fused=True)."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.optim.adam import adam

from hyrfpack.ops.adam import reference


def adam_step(
    values: list[Tensor],
    gradients: list[Tensor],
    exp_avg: list[Tensor],
    exp_avg_sq: list[Tensor],
    step: int,
    rate: float,
    betas: tuple[float, float],
    eps: float,
) -> Tensor:
    """As `hyrfpack.ops.adam.adam_step`."""
    gradients = [gradient.contiguous() for gradient in gradients]  # the kernel counts through all four alike
    broken = not all(_squares_are_finite(gradient) for gradient in gradients)
    if broken:
        reference.adam_step(values, gradients, exp_avg, exp_avg_sq, step, rate, betas, eps)
    else:
        # Torch counts the steps, in one number for each tensor, before it uses them.
        steps = list(torch.full((len(values),), step - 1.0).unbind())
        adam(
            values,
            gradients,
            exp_avg,
            exp_avg_sq,
            [],
            steps,
            fused=True,
            amsgrad=False,
            beta1=betas[0],
            beta2=betas[1],
            lr=rate,
            weight_decay=0.0,
            eps=eps,
            maximize=False,
        )
    return torch.tensor(broken)


def _squares_are_finite(gradient: Tensor) -> bool:
    if not gradient.numel():
        return True
    low, high = gradient.aminmax()  # one pass; a NaN anywhere is in both
    return bool((torch.maximum(-low, high) ** 2).isfinite())

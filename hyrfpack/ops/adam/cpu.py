"""A step of Adam in torch's fused kernel: the bits of torch.optim.Adam(fused=True)."""

from __future__ import annotations

from collections import defaultdict

import torch
from torch import Tensor
from torch.optim.adam import adam

from hyrfpack.ops.adam import reference


def adam_step(
    values: list[Tensor],
    gradients: list[Tensor],
    exp_avg: list[Tensor],
    exp_avg_sq: list[Tensor],
    steps: list[int],
    rates: list[float],
    betas: tuple[float, float],
    eps: float,
) -> Tensor:
    """As `hyrfpack.ops.adam.adam_step`."""
    gradients = [gradient.contiguous() for gradient in gradients]  # the kernel counts through all four alike
    broken = [not _squares_are_finite(gradient) for gradient in gradients]
    # Torch counts the steps, in one number for each tensor, before it uses them.
    counts = (torch.tensor(steps, dtype=torch.float32) - 1).unbind()
    alike: dict[float, list[int]] = defaultdict(list)  # what the kernel takes together
    for place, rate in enumerate(rates):
        if broken[place]:
            one = [[tensors[place]] for tensors in (values, gradients, exp_avg, exp_avg_sq)]
            reference.adam_step(one[0], one[1], one[2], one[3], [steps[place]], [rate], betas, eps)
        else:
            alike[rate].append(place)
    for rate, places in alike.items():
        adam(
            [values[place] for place in places],
            [gradients[place] for place in places],
            [exp_avg[place] for place in places],
            [exp_avg_sq[place] for place in places],
            [],
            [counts[place] for place in places],
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

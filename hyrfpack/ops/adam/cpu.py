"""Implements the Adam step with torch's fused kernel, bit-identical to torch.optim.Adam(fused=True)."""

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
    enabled: Tensor | None = None,
) -> Tensor:
    """Take the step of `hyrfpack.ops.adam.adam_step`."""
    if enabled is not None and not enabled:
        return torch.zeros(len(values), dtype=torch.bool)
    # The fused kernel indexes all four tensors alike, so the gradients must be contiguous, too.
    gradients = [gradient.contiguous() for gradient in gradients]
    skipped = [not _squares_are_finite(gradient) for gradient in gradients]
    # Torch increments each tensor's step number before it uses it.
    previous_steps = (torch.tensor(steps, dtype=torch.float32) - 1).unbind()
    indices_by_rate: dict[float, list[int]] = defaultdict(list)  # One kernel call takes tensors of one learning rate.
    for index, rate in enumerate(rates):
        if skipped[index]:
            x, g, m, v = ([tensors[index]] for tensors in (values, gradients, exp_avg, exp_avg_sq))
            reference.adam_step(x, g, m, v, [steps[index]], [rate], betas, eps)
        else:
            indices_by_rate[rate].append(index)
    for rate, indices in indices_by_rate.items():
        adam(
            [values[index] for index in indices],
            [gradients[index] for index in indices],
            [exp_avg[index] for index in indices],
            [exp_avg_sq[index] for index in indices],
            [],
            [previous_steps[index] for index in indices],
            fused=True,
            amsgrad=False,
            beta1=betas[0],
            beta2=betas[1],
            lr=rate,
            weight_decay=0.0,
            eps=eps,
            maximize=False,
        )
    return torch.tensor(skipped)


def _squares_are_finite(gradient: Tensor) -> bool:
    """Return whether g^2 is finite for all elements of a gradient."""
    if not gradient.numel():
        return True
    low, high = gradient.aminmax()  # This takes one pass; both are NaN if any element is.
    return bool((torch.maximum(-low, high) ** 2).isfinite())

"""Implements the Adam step in plain torch for any device and dtype. This reference defines the correct result."""

from __future__ import annotations

import math

import torch
from torch import Tensor


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
    beta1, beta2 = betas
    skipped = []
    for x, g, m, v, step, rate in zip(values, gradients, exp_avg, exp_avg_sq, steps, rates, strict=True):
        correction1, correction2 = 1 - beta1**step, 1 - beta2**step
        finite = (g * g).isfinite()
        is_skipped = ~finite.all()
        if enabled is not None:
            finite, is_skipped = finite & enabled, is_skipped & enabled
        skipped.append(is_skipped)
        new_m = beta1 * m + (1 - beta1) * g
        new_v = beta2 * v + (1 - beta2) * (g * g)
        new_x = x - rate / correction1 * new_m / (new_v.sqrt() / math.sqrt(correction2) + eps)
        for old, new in ((x, new_x), (m, new_m), (v, new_v)):
            old.copy_(torch.where(finite, new, old))
    return torch.stack(skipped)

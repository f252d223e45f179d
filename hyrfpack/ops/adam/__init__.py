"""Adam (Kingma and Ba 2015): takes one step on many parameters in place."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from hyrfpack.ops.adam import reference
from hyrfpack.ops.dispatch import choose_implementation

__all__ = ["adam_step"]


@torch.no_grad()
def adam_step(
    values: Sequence[Tensor],
    gradients: Sequence[Tensor],
    exp_avg: Sequence[Tensor],
    exp_avg_sq: Sequence[Tensor],
    *,
    step: int | Sequence[int],
    rate: float | Sequence[float],
    betas: tuple[float, float] = (0.9, 0.999),
    eps: float = 1e-15,
    enabled: Tensor | None = None,
    implementation: str = "auto",
) -> Tensor:
    """Take one Adam step without weight decay on every tensor.

        m <- b1 m + (1 - b1) g        v <- b2 v + (1 - b2) g^2
        x <- x - rate (m / (1 - b1^step)) / (sqrt(v / (1 - b2^step)) + eps)

    An element whose g^2 is not finite (NaN, infinity or, in float32, |g| > 1.8e19) keeps its x, m and v. Otherwise a
    single such gradient would make m and v non-finite permanently. All other elements are updated.

    Args:
        values: x of each tensor, of any shape, contiguous. Modified in place.
        gradients: g of each tensor, with the shapes of `values`, in any layout.
        exp_avg, exp_avg_sq: m and v of each tensor, shaped like `values`; zero before the first step. Modified in
            place.
        step: number of this step, counted from 1: one for all tensors, or one per tensor.
        rate: learning rate: one for all tensors, or one per tensor.
        betas: b1 and b2, in [0, 1).
        eps: positive.
        enabled: bool scalar on the device of the tensors; if it is False, nothing changes and nothing counts as
            skipped. None is True.
        implementation: "auto", "reference", "cpu" (float32; torch's fused kernel, bit-identical to
            torch.optim.Adam(fused=True)) or "gpu" (float32; one launch for all tensors).

    Returns:
        (tensors,) bool on the device of the tensors: whether any element of a tensor was skipped. Does not
        synchronise with the device.

    Raises:
        ValueError: the lists differ in length, shapes, dtypes, devices or layouts do not match, or `step` is below 1.

    Example:
        >>> x, m, v = torch.ones(3), torch.zeros(3), torch.zeros(3)
        >>> skipped = adam_step([x], [torch.full((3,), 2.0)], [m], [v], step=1, rate=0.1)
        >>> x, skipped
        (tensor([0.9000, 0.9000, 0.9000]), tensor([False]))
    """
    tensors = list(zip(values, gradients, exp_avg, exp_avg_sq, strict=True))
    for value, *others in tensors:
        if any(other.shape != value.shape for other in others):
            raise ValueError(f"shapes differ: {tuple(value.shape)} and {[tuple(other.shape) for other in others]}")
        if not all(tensor.is_contiguous() for tensor in (value, *others[1:])):
            raise ValueError(f"values and moments of shape {tuple(value.shape)} must be contiguous to change in place")
    steps = [step] * len(tensors) if isinstance(step, int) else list(step)
    rates = list(rate) if isinstance(rate, Sequence) else [rate] * len(tensors)
    if not tensors or min(steps) < 1:
        raise ValueError(f"{len(tensors)} tensors and step {step}; there must be a tensor, and steps count from 1")
    if not len(steps) == len(rates) == len(tensors):
        raise ValueError(f"{len(tensors)} tensors, {len(steps)} steps and {len(rates)} rates")
    chosen = choose_implementation(
        "adam_step", implementation, ("reference", "cpu", "gpu"), *(tensor for group in tensors for tensor in group)
    )
    run: Callable[..., Tensor] = reference.adam_step
    if chosen == "gpu":
        from hyrfpack.ops.adam import gpu

        run = gpu.adam_step
    elif chosen == "cpu":
        from hyrfpack.ops.adam import cpu

        run = cpu.adam_step
    return run(*map(list, zip(*tensors, strict=True)), steps, rates, betas, eps, enabled)

"""Decides on the device whether a training step is valid."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from hyrfpack.render.reserve import Reserve

MAX_LOSS = float(np.finfo(np.float32).max)
MAX_GRADIENT = MAX_LOSS**0.5  # Adam squares gradients.


class StepChecks(NamedTuple):
    """What decides on the device whether a step is valid.

    Attributes:
        valid: bool scalar.
        demand: (4,) int64, see `Rendering.demand`.
        norms: (tensors,) the largest absolute value of each gradient; NaN if any is.
    """

    valid: Tensor
    demand: Tensor
    norms: Tensor


def check_step(loss: Tensor, gradients: Sequence[Tensor], demand: Tensor, reserve: Reserve) -> StepChecks:
    """Return whether a step is valid, without waiting for the device.

    It is valid if the loss and all gradients are finite and the reserve was large enough.

    Args:
        loss: scalar.
        gradients: all gradients of the step, at least one.
        demand: what the step's rendering needed, see `Rendering.demand`.
        reserve: the memory that it was rendered into.
    """
    norms = torch.stack(torch._foreach_norm(list(gradients), torch.inf))
    # float64 holds counts exactly. It is one element for each tensor, so its rate does not matter.
    numbers = torch.cat((loss.double()[None], norms, demand))
    counted = (1, MAX_LOSS), (len(norms), MAX_GRADIENT), *((1, limit) for limit in reserve.limits)
    limits = torch.cat([numbers.new_full((count,), limit) for count, limit in counted])
    return StepChecks((numbers <= limits).all(), demand, norms)

"""What the trainer keeps of a step between giving it to a GPU and reading its numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from hyrfpack.ops.transfer import HostCopy, tensor_like
from hyrfpack.render import Rendering
from hyrfpack.render.reserve import Reserve
from hyrfpack.scene import Picture, View

MAX_LOSS = float(np.finfo(np.float32).max)
MAX_GRADIENT = MAX_LOSS**0.5  # Adam squares gradients.


@dataclass(frozen=True)
class RenderedView:
    """A view whose gradients are computed.

    Attributes:
        view, picture: the view and its photo.
        loss, error: scalars on the device: loss, and mean squared error, NaN if all of the photo is masked.
        rendering: the rendering, with its absolute gradients and without the graph of its other ones.
        reserve: the memory that it was rendered into, or None.
    """

    view: View
    picture: Picture
    loss: Tensor
    error: Tensor
    rendering: Rendering
    reserve: Reserve | None


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
    limits = MAX_LOSS, *[MAX_GRADIENT] * len(norms), *reserve.limits
    return StepChecks((numbers <= tensor_like(limits, numbers)).all(), demand, norms)


@dataclass(frozen=True)
class LaunchedStep:
    """A step that the device was given, and whose numbers are on their way to the host.

    Attributes:
        step: number of the step, from 1.
        reserved: the view and its photo if it was rendered into a reserve, or None.
        numbers: statistics of the step; then its `StepChecks` if it has a reserve, otherwise for each parameter with a
            gradient whether that is not finite.
        stats_length: how many of the numbers are statistics.
    """

    step: int
    reserved: tuple[View, Picture] | None
    numbers: HostCopy
    stats_length: int

    def read_numbers(self) -> tuple[list[float], list[float]]:
        """Wait for the numbers, and return the statistics and the others."""
        numbers = self.numbers.tolist()
        return numbers[: self.stats_length], numbers[self.stats_length :]


@dataclass(frozen=True)
class ConfirmedStep:
    """A step whose numbers were read and found valid.

    Attributes:
        step: number of the step, from 1.
        loss: mean loss of all ranks' views.
        error: mean squared error of all ranks' views; NaN if masks leave no pixel of any of their photos.
        stop: whether any rank was asked to stop.
        was_retaken: whether it was taken again, because a first reserve was too small.
    """

    step: int
    loss: float
    error: float
    stop: bool
    was_retaken: bool

"""What the trainer keeps of a step between giving it to a GPU and reading its numbers."""

from __future__ import annotations

from dataclasses import dataclass

from hyrfpack.ops.transfer import HostCopy
from hyrfpack.scene import Picture, View
from hyrfpack.train.gradients import ViewGradients


@dataclass(frozen=True)
class RenderedView:
    """A view whose gradients are computed.

    Attributes:
        view, picture: the view and its photo.
        result: the gradients and the rendering.
    """

    view: View
    picture: Picture
    result: ViewGradients


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

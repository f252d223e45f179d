"""What the trainer keeps of a step between giving it to a GPU and reading its numbers."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from hyrfpack.ops.transfer import HostCopy
from hyrfpack.render import Rendering
from hyrfpack.render.reserve import Reserve
from hyrfpack.scene import Picture, View


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


@dataclass(frozen=True)
class LaunchedStep:
    """A step that the device was given, and whose numbers are on their way to the host.

    Attributes:
        step: number of the step, from 1.
        view, picture: the view and its photo; None on one of several processes whose view had a problem.
        numbers: statistics of the step; `Rendering.valid` and `Rendering.demand`, if there is a demand; and for each
            parameter with a gradient its largest absolute value or, without a demand, whether it is not finite.
        lengths: the length of each of these three.
    """

    step: int
    view: View | None
    picture: Picture | None
    numbers: HostCopy
    lengths: tuple[int, int, int]

    def read_numbers(self) -> tuple[list[float], list[float], list[float]]:
        """Wait for the numbers, and return the three kinds."""
        numbers = self.numbers.tolist()
        first, second, _ = self.lengths
        return numbers[:first], numbers[first : first + second], numbers[first + second :]


@dataclass(frozen=True)
class SettledStep:
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

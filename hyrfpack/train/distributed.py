"""Exchange gradients and step statistics between the processes that train one model."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from hyrfpack.errors import HyrfTrainingError
from hyrfpack.parallel.ranks import Ranks

# Each gradient begins at a multiple of so many numbers in the message: the Adam kernel reads 16 bytes at a time.
GRADIENT_ALIGNMENT = 4


@dataclass(frozen=True)
class StepStats:
    """Statistics of one step over all ranks.

    Attributes:
        loss: mean loss of all ranks' views.
        error: mean squared error of all ranks' views; NaN if masks leave no pixel of any of their photos.
        stop: whether any rank was asked to stop.
        problem: whether any rank cannot continue.
    """

    loss: float
    error: float
    stop: bool = False
    problem: bool = False

    @classmethod
    def from_sums(cls, sums: Sequence[float], ranks: int) -> StepStats:
        """Unpack the sums over `ranks` ranks of what `pack_step_stats` returns."""
        loss, error, counted, stop, problem = sums
        return cls(loss / ranks, error / counted if counted else math.nan, stop > 0, problem > 0)


def pack_step_stats(loss: Tensor, error: Tensor, *, stop: bool, problem: bool) -> Tensor:
    """Pack one rank's statistics into a tensor (5,), whose sum over ranks `StepStats.from_sums` unpacks.

    Args:
        loss: scalar loss of the rank's view.
        error: scalar mean squared error of the view; NaN if the mask leaves no pixel of its photo.
        stop, problem: see `StepStats`.
    """
    masked = torch.isnan(error)
    flags = torch.tensor((stop, problem), dtype=loss.dtype).to(loss.device, non_blocking=True)
    return torch.cat((torch.stack((loss, torch.where(masked, 0, error), (~masked).to(loss))), flags))


def average_gradients(ranks: Ranks, parameters: Sequence[nn.Parameter], numbers: Tensor) -> Tensor:
    """Replace gradients by their means over all ranks, and return the sums of `numbers` over all ranks.

    Gradients and numbers are sent in one message, because the cost of an all-reduce depends more on the number of
    messages than on their size. A missing gradient counts as zeros. The results have the same bits on all ranks.

    Args:
        parameters: parameters of the same shapes on each rank.
        numbers: (K,) float32 on the parameters' device.

    Returns:
        (K,) sums of the numbers.

    Raises:
        HyrfError: another process has ended.

    Example:
        >>> weight = nn.Parameter(torch.zeros(2))
        >>> weight.grad = torch.ones(2)
        >>> average_gradients(Ranks(), [weight], torch.tensor([3.0])), weight.grad
        (tensor([3.]), tensor([1., 1.]))
    """
    padding = numbers.new_zeros(GRADIENT_ALIGNMENT - 1)
    pieces, sizes = [], []
    for parameter in parameters:
        gradient = torch.zeros_like(parameter) if parameter.grad is None else parameter.grad
        missing = -gradient.numel() % GRADIENT_ALIGNMENT
        pieces += [gradient.reshape(-1), padding[:missing]]
        sizes += [gradient.numel(), missing]
    flat = ranks.all_reduce(torch.cat([*pieces, numbers]))
    *parts, sums = flat.split([*sizes, len(numbers)])
    for parameter, mean in zip(parameters, parts[::2], strict=True):
        parameter.grad = mean.div_(ranks.size).view_as(parameter)
    return sums


def check_settings(ranks: Ranks, settings: Mapping[str, object]) -> None:
    """Check that all ranks were started with the same settings.

    Raises:
        HyrfTrainingError: a rank has other settings than rank 0. The message names the first such rank and the settings
            that differ.
    """
    first, *others = ranks.all_gather(settings)
    for rank, theirs in enumerate(others, 1):
        if different := sorted(name for name in first.keys() | theirs.keys() if first.get(name) != theirs.get(name)):
            raise HyrfTrainingError(
                f"process {rank} of {ranks.size} was started with other settings than process 0 "
                f"({', '.join(different)})",
                fix="start all with the same command, photos and versions",
            )


def digest(tensors: Iterable[Tensor]) -> str:
    """Return the SHA-256 digest of the tensors' bytes, in hexadecimal digits."""
    hasher = hashlib.sha256()
    for tensor in tensors:
        hasher.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    return hasher.hexdigest()

"""What processes that train one model tell each other in a step: gradients and a few numbers, in one message."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from hyrfpack.errors import HyrfTrainingError
from hyrfpack.parallel.ranks import Ranks


@dataclass(frozen=True)
class Told:
    """What the ranks have told each other of a step.

    Attributes:
        loss, error: means over the ranks' views; the mean squared error is NaN where all of each photo is masked.
        stop, problem: whether some rank is asked to stop, or cannot go on.
    """

    loss: float
    error: float
    stop: bool = False
    problem: bool = False

    @classmethod
    def of(cls, sums: Sequence[float], ranks: int) -> Told:
        """From the sums over so many ranks of what `to_tell` makes."""
        loss, error, counted, stop, problem = sums
        return cls(loss / ranks, error / counted if counted else math.nan, stop > 0, problem > 0)


def to_tell(loss: Tensor, error: Tensor, *, stop: bool, problem: bool) -> Tensor:
    """A rank's share of `Told`, (5,), to be summed; loss and error are scalars."""
    masked = torch.isnan(error)
    flags = torch.tensor((stop, problem), dtype=loss.dtype).to(loss.device, non_blocking=True)
    return torch.cat((torch.stack((loss, torch.where(masked, 0, error), (~masked).to(loss))), flags))


def averaged(ranks: Ranks, parameters: Sequence[nn.Parameter], numbers: Tensor) -> Tensor:
    """Give every rank the mean of all ranks' gradients, and the sum of some numbers.

    All is laid end to end and summed as one: a message costs more by its number than by its bytes. A parameter
    without a gradient counts as one of zeros. Sums have the same bits on all ranks.

    Args:
        parameters: of the same shapes on each rank; their gradients are replaced.
        numbers: (K,) float32 on the parameters' device.

    Returns:
        (K,) sums of the numbers.

    Raises:
        HyrfError: another process has gone.

    Example:
        >>> weight = nn.Parameter(torch.zeros(2))
        >>> weight.grad = torch.ones(2)
        >>> averaged(Ranks(), [weight], torch.tensor([3.0])), weight.grad
        (tensor([3.]), tensor([1., 1.]))
    """
    gradients = [torch.zeros_like(p) if p.grad is None else p.grad for p in parameters]
    flat = ranks.all_reduce(torch.cat([*(gradient.reshape(-1) for gradient in gradients), numbers]))
    *means, sums = flat.split([*(parameter.numel() for parameter in parameters), len(numbers)])
    for parameter, mean in zip(parameters, means, strict=True):
        parameter.grad = mean.div_(ranks.size).view_as(parameter)
    return sums


def check_settings(ranks: Ranks, settings: Mapping[str, object]) -> None:
    """Refuse to train one model by different settings.

    Raises:
        HyrfTrainingError: a rank was started with others than rank 0; the first such one and what differs are named.
    """
    first, *others = ranks.all_gather(settings)
    for rank, theirs in enumerate(others, 1):
        if different := sorted(name for name in first.keys() | theirs.keys() if first.get(name) != theirs.get(name)):
            raise HyrfTrainingError(
                f"process {rank} of {ranks.size} was started with other settings than process 0 "
                f"({', '.join(different)}); start all with the same command, photos and versions"
            )


def digest(tensors: Iterable[Tensor]) -> str:
    """SHA-256 of the bits of tensors."""
    known = hashlib.sha256()
    for tensor in tensors:
        known.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    return known.hexdigest()

"""Bringing small things to a device."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor


def tensor_like(numbers: Sequence[float], other: Tensor) -> Tensor:
    """A few numbers as a tensor of another's type, on its device.

    As `other.new_tensor(numbers)`, which makes the host wait for all that a GPU still has to do; this does not.
    """
    return torch.tensor(numbers, dtype=other.dtype).to(other.device, non_blocking=other.is_cuda)

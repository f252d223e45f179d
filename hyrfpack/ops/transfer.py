"""Copies small amounts of data to a device without blocking."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor


def tensor_like(numbers: Sequence[float], other: Tensor) -> Tensor:
    """Return a few numbers as a tensor with the dtype and device of `other`.

    Equivalent to `other.new_tensor(numbers)`, which makes the host wait until the GPU has finished all queued work.
    This function does not wait.
    """
    return torch.tensor(numbers, dtype=other.dtype).to(other.device, non_blocking=other.is_cuda)

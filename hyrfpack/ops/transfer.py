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


class HostCopy:
    """A copy of a tensor on the host, for which a GPU's host waits only when it reads it.

    Example:
        >>> HostCopy(torch.tensor([1.0, 2.0])).tolist()
        [1.0, 2.0]
    """

    def __init__(self, values: Tensor) -> None:
        """Begin to copy a tensor; later changes of it do not change the copy of one on a GPU."""
        self._values, self._is_complete = values, None
        if values.is_cuda:
            # Without pinned memory the copy would wait for the device.
            self._values = torch.empty(values.shape, dtype=values.dtype, pin_memory=True)
            self._values.copy_(values, non_blocking=True)
            self._is_complete = torch.cuda.Event()
            self._is_complete.record()

    def tolist(self) -> list:
        """Wait until the copy is complete, and return its values."""
        if self._is_complete is not None:
            self._is_complete.synchronize()
        return self._values.tolist()

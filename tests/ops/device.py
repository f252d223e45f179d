"""The device for tests of GPU kernels: the GPU where there is one, else the CPU with Triton's interpreter."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from hyrfpack.ops.dispatch import has_triton

KERNEL_DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
IS_INTERPRETED = KERNEL_DEVICE == "cpu"

needs_triton = pytest.mark.skipif(not has_triton(), reason="Triton is not installed")


def gpu(tensor: Tensor) -> Tensor:
    """Move a tensor to the device of the GPU kernels and keep its requires_grad."""
    return tensor.detach().to(KERNEL_DEVICE).requires_grad_(tensor.requires_grad)

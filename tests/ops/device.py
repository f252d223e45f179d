"""Where the gpu kernels are tested: on the GPU when there is one, else on the CPU in Triton's interpreter."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from hyrfpack.ops.dispatch import has_triton

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
INTERPRETED = DEVICE == "cpu"

needs_triton = pytest.mark.skipif(not has_triton(), reason="Triton is not installed")


def gpu(tensor: Tensor) -> Tensor:
    """The tensor where the gpu kernels take it; keeps requires_grad."""
    return tensor.detach().to(DEVICE).requires_grad_(tensor.requires_grad)

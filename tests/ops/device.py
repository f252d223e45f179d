"""The device for tests of GPU kernels: the GPU where there is one, else the CPU with Triton's interpreter."""

from __future__ import annotations

from collections.abc import Container, Iterable

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


def pair_with_implementations(cases: Iterable, slow_on_gpu: Container, implementations: Iterable) -> list:
    """Return parameters (implementation, case), where some cases of the slow interpreter have the mark `acceptance`.

    Args:
        cases: all cases of a test.
        slow_on_gpu: those that run the same branches of the GPU kernels as others.
        implementations: names of implementations, or parameters with marks.
    """
    cases, pairs = list(cases), []
    for implementation in implementations:
        parameter = implementation if hasattr(implementation, "marks") else pytest.param(implementation)
        (name,) = parameter.values
        for case in cases:
            slow = [pytest.mark.acceptance] if name == "gpu" and IS_INTERPRETED and case in slow_on_gpu else []
            pairs.append(pytest.param(name, case, marks=[*parameter.marks, *slow]))
    return pairs

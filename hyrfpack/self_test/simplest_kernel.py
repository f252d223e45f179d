"""The simplest kernel, which fails only where Triton cannot compile or launch anything."""

from __future__ import annotations

import torch
import triton
import triton.language as tl


@triton.jit
def _store_one_kernel(target):
    tl.store(target, 1)


def launch_simplest_kernel(device: torch.device) -> None:
    """Compile and launch a kernel, and wait for its result.

    Raises:
        RuntimeError: the kernel did not write its number. Triton raises errors of many other types.
    """
    target = torch.zeros(1, dtype=torch.int32, device=device)
    _store_one_kernel[(1,)](target)
    if target.item() != 1:
        raise RuntimeError("the simplest kernel wrote nothing")

"""Chooses which implementation of an operation runs."""

from __future__ import annotations

import torch
from torch import Tensor

from hyrfpack.parallel import has_numba


def choose(implementation: str, available: tuple[str, ...], *tensors: Tensor) -> str:
    """Name the implementation for these tensors.

    Args:
        implementation: "auto", or a name out of `available` to force it.
        available: what the operation offers, "reference" always among it.
        tensors: the operation's inputs; they must agree in device and dtype.

    Returns:
        A name out of `available`. "auto" takes "cpu" for float32 tensors on the CPU when Numba is installed and
        "reference" (plain torch, any device, any dtype) otherwise.

    Raises:
        ValueError: the name is not offered, it cannot take these tensors, or the tensors disagree.
    """
    first = tensors[0]
    for tensor in tensors[1:]:
        if tensor.device != first.device or tensor.dtype != first.dtype:
            raise ValueError(f"tensors disagree: {first.dtype} on {first.device} and {tensor.dtype} on {tensor.device}")
    if implementation != "auto":
        if implementation not in available:
            raise ValueError(f"no implementation '{implementation}'; there are {', '.join(available)}")
        if implementation == "cpu" and (first.device.type != "cpu" or first.dtype != torch.float32):
            raise ValueError(f"the cpu kernels take float32 on the CPU, not {first.dtype} on {first.device}")
        return implementation
    if "cpu" in available and first.device.type == "cpu" and first.dtype == torch.float32 and has_numba():
        return "cpu"
    return "reference"

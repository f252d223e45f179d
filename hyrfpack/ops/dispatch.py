"""Chooses which implementation of an operation runs."""

from __future__ import annotations

import os
from functools import cache

import torch
from torch import Tensor

from hyrfpack.parallel import has_numba


@cache
def has_triton() -> bool:
    """Whether GPU kernels can be built: Triton comes with torch wherever torch runs on CUDA or ROCm."""
    try:
        import triton  # noqa: F401
    except ImportError:
        return False
    return True


def interpreting() -> bool:
    """Whether Triton runs kernels in its interpreter, on tensors of the CPU: slowly, to test them without a GPU."""
    return os.environ.get("TRITON_INTERPRET", "0") == "1"


def choose(implementation: str, available: tuple[str, ...], *tensors: Tensor) -> str:
    """Name the implementation for these tensors.

    Args:
        implementation: "auto", or a name out of `available` to force it.
        available: what the operation offers, "reference" always among it.
        tensors: the operation's inputs; they must agree in device and dtype.

    Returns:
        A name out of `available`. "auto" takes "gpu" for float32 tensors on a CUDA or ROCm device when Triton is
        installed, "cpu" for float32 tensors on the CPU when Numba is, and "reference" (plain torch, any device, any
        dtype) otherwise.

    Raises:
        ValueError: the name is not offered, it cannot take these tensors, or the tensors disagree.
    """
    first = tensors[0]
    for tensor in tensors[1:]:
        if tensor.device != first.device or tensor.dtype != first.dtype:
            raise ValueError(f"tensors disagree: {first.dtype} on {first.device} and {tensor.dtype} on {tensor.device}")
    single, place = first.dtype == torch.float32, first.device.type
    fits = {
        "reference": True,
        "cpu": single and place == "cpu",
        "gpu": single and (place == "cuda" or (place == "cpu" and interpreting())),
    }
    if implementation != "auto":
        if implementation not in available:
            raise ValueError(f"no implementation '{implementation}'; there are {', '.join(available)}")
        if not fits[implementation]:
            where = {"cpu": "on the CPU", "gpu": "on a CUDA or ROCm device"}[implementation]
            raise ValueError(f"the {implementation} kernels take float32 {where}, not {first.dtype} on {first.device}")
        if implementation == "gpu" and not has_triton():
            raise ValueError("the gpu kernels need Triton, which is not installed")
        if implementation == "gpu" and place == "cuda":
            _check_current(first.device)
        return implementation
    if "gpu" in available and fits["gpu"] and place == "cuda" and has_triton():
        _check_current(first.device)
        return "gpu"
    if "cpu" in available and fits["cpu"] and has_numba():
        return "cpu"
    return "reference"


def _check_current(device: torch.device) -> None:
    """Kernels are launched on torch's current device, whatever their tensors are on."""
    if device.index != torch.cuda.current_device():
        raise ValueError(f"kernels run on the current GPU; make it this one by torch.cuda.set_device({device.index})")

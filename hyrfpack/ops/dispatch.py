"""Chooses which implementation of an operation runs."""

from __future__ import annotations

import os
from collections.abc import Iterable
from functools import cache

import torch
from torch import Tensor

from hyrfpack.kernel_errors import PLAIN_TORCH_VARIABLE
from hyrfpack.parallel import has_numba

# Every operation that has Triton kernels.
GPU_OPERATIONS = (
    "activate_geometry",
    "adam_step",
    "background_grid",
    "composite",
    "contract",
    "encode_views",
    "frustum_cull",
    "hash_encode",
    "mlp",
    "photometric_loss",
    "rasterize",
    "rasterize_shaded",
    "shade",
)
# Stands for the bfloat16 products of several operations, which their float32 kernels replace.
MIXED_PRECISION = "mixed_precision"
_replaced_operations: frozenset[str] = frozenset()


def replaced_operations() -> frozenset[str]:
    """Return the operations that run as plain torch on a GPU in this process.

    Their kernels are unusable, or the user wants none.
    """
    return frozenset(GPU_OPERATIONS) if is_plain_torch_requested() else _replaced_operations


def is_mixed_precision_usable() -> bool:
    """Return whether bfloat16 products work on the GPU of this process."""
    return MIXED_PRECISION not in _replaced_operations


def is_plain_torch_requested() -> bool:
    """Return whether the environment asks for plain torch in place of all GPU kernels."""
    return os.environ.get(PLAIN_TORCH_VARIABLE, "") not in ("", "0")


def set_replaced_operations(operations: Iterable[str]) -> None:
    """Replace the kernels of these operations, and of no others, by plain torch wherever "auto" would choose "gpu".

    MIXED_PRECISION among them makes models multiply in float32. The choice of a device calls this with what failed the
    self-test there, see `hyrfpack.self_test`.

    Raises:
        ValueError: a name is neither in GPU_OPERATIONS nor MIXED_PRECISION.
    """
    global _replaced_operations
    names = frozenset(operations)
    if unknown := sorted(names.difference(GPU_OPERATIONS, [MIXED_PRECISION])):
        raise ValueError(f"no GPU operation '{unknown[0]}'; there are {', '.join(GPU_OPERATIONS)}")
    _replaced_operations = names


@cache
def has_triton() -> bool:
    """Return whether GPU kernels can be compiled. Builds of torch for CUDA and ROCm include Triton."""
    try:
        import triton  # noqa: F401
    except Exception:  # beside a torch or LLVM that it does not fit, it raises errors of many types
        return False
    return True


def is_interpreting() -> bool:
    """Return whether Triton runs kernels in its interpreter, on CPU tensors.

    The interpreter is slow; tests use it to run GPU kernels without a GPU.
    """
    return os.environ.get("TRITON_INTERPRET", "0") == "1"


def choose_implementation(operation: str, implementation: str, available: tuple[str, ...], *tensors: Tensor) -> str:
    """Choose the implementation of an operation that runs on the given tensors.

    Args:
        operation: the operation's name; one of GPU_OPERATIONS if "gpu" is available.
        implementation: "auto", or a name from `available` to force that implementation.
        available: names of the operation's implementations; "reference" is always one of them.
        tensors: the operation's inputs; all must have the same device and dtype.

    Returns:
        A name from `available`. For float32 tensors, "auto" selects "gpu" on a CUDA or ROCm device if Triton is
        installed and the operation is not one of `replaced_operations`, and "cpu" on the CPU if Numba is installed.
        Otherwise it selects "reference" (plain torch, any device, any dtype).

    Raises:
        ValueError: the name is not available, the implementation does not support these tensors, or the tensors
            differ in device or dtype.
    """
    first = tensors[0]
    for tensor in tensors[1:]:
        if tensor.device != first.device or tensor.dtype != first.dtype:
            raise ValueError(f"tensors disagree: {first.dtype} on {first.device} and {tensor.dtype} on {tensor.device}")
    is_float32, device_type = first.dtype == torch.float32, first.device.type
    is_supported = {
        "reference": True,
        "cpu": is_float32 and device_type == "cpu",
        "gpu": is_float32 and (device_type == "cuda" or (device_type == "cpu" and is_interpreting())),
    }
    if implementation != "auto":
        if implementation not in available:
            raise ValueError(f"no implementation '{implementation}'; there are {', '.join(available)}")
        if not is_supported[implementation]:
            where = {"cpu": "on the CPU", "gpu": "on a CUDA or ROCm device"}[implementation]
            raise ValueError(f"the {implementation} kernels take float32 {where}, not {first.dtype} on {first.device}")
        if implementation == "gpu" and not has_triton():
            raise ValueError("the gpu kernels need Triton, which is not installed")
        if implementation == "gpu" and device_type == "cuda":
            _check_current(first.device)
        return implementation
    is_gpu_usable = device_type == "cuda" and has_triton() and operation not in replaced_operations()
    if "gpu" in available and is_supported["gpu"] and is_gpu_usable:
        _check_current(first.device)
        return "gpu"
    if "cpu" in available and is_supported["cpu"] and has_numba():
        return "cpu"
    return "reference"


def _check_current(device: torch.device) -> None:
    """Raise ValueError unless `device` is torch's current GPU, because Triton launches kernels on that one."""
    if device.index != torch.cuda.current_device():
        raise ValueError(f"kernels run on the current GPU; make it this one by torch.cuda.set_device({device.index})")

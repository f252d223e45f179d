"""Turn running out of memory, of a GPU or of this machine, into an error that says what to reduce."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager

from hyrfpack.errors import HyrfError, short_reason

MAX_REASON_LENGTH = 160
GPU_PROBLEM = "the GPU's memory ran out"
# What CUDA, HIP, their libraries (cuBLAS, cuDNN) and Triton say where torch's allocator was not asked: a library's
# memory, a kernel's code or stack.
_GPU_MESSAGE = re.compile(
    r"(CUDA|HIP)( driver)? error: out of memory|_STATUS_ALLOC_FAILED|Triton Error \[\w+\]:.*out of memory"
)


@contextmanager
def explain_out_of_memory(fix: str) -> Iterator[None]:
    """Raise a HyrfError with this fix if memory runs out in the block. It also serves as a decorator.

    If it is the memory of a GPU, the fix says that the CPU can be used, too.

    Raises:
        HyrfError: memory ran out.
    """
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        problem = describe_out_of_memory(error)
        if problem is None:
            raise
        raise HyrfError(
            problem, fix=f"{fix}, or use `device='cpu'`" if problem.startswith(GPU_PROBLEM) else fix
        ) from error


def has_run_out_of_memory(error: BaseException) -> bool:
    """Return whether an error, or the one that caused it, says that memory ran out."""
    causes = (error, error.__cause__)
    return any(cause is not None and describe_out_of_memory(cause) is not None for cause in causes)


def describe_out_of_memory(error: BaseException) -> str | None:
    """Return what to tell the user if an error says that memory ran out; None for any other error.

    The types of torch's errors are compared by name, so that this does not import torch.
    """
    is_gpu_message = isinstance(error, RuntimeError) and _GPU_MESSAGE.search(str(error))
    if type(error).__name__ == "OutOfMemoryError" or is_gpu_message:
        return f"{GPU_PROBLEM} ({short_reason(error, MAX_REASON_LENGTH)})"  # type: ignore[arg-type]
    if isinstance(error, MemoryError):
        return f"memory ran out ({short_reason(error, MAX_REASON_LENGTH)})"
    if isinstance(error, RuntimeError) and "DefaultCPUAllocator" in str(error):
        # The message may begin with a place in torch's source.
        message = str(error).partition("DefaultCPUAllocator: ")[2] or str(error)
        return f"memory ran out ({short_reason(RuntimeError(message), MAX_REASON_LENGTH)})"
    return None

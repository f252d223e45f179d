"""Say which GPU kernel failed if Triton could not compile or launch it."""

from __future__ import annotations

import re
from traceback import walk_tb

PLAIN_TORCH_VARIABLE = "HYRFPACK_PLAIN_TORCH"
KERNEL_ERROR_FIX = (
    f"test the kernels with 'hyrfpack doctor', and report its output; {PLAIN_TORCH_VARIABLE}=1 in the environment runs "
    "plain torch in place of all kernels, far slower"
)
MAX_REASON_LENGTH = 160


def describe_kernel_error(error: BaseException) -> str | None:
    """Return what to tell the user if an error was raised while Triton compiled or launched a kernel; else None.

    Triton raises errors of many types, also of the compilers that it runs and of its cache. So the frames of the
    traceback decide.
    """
    package, kernel = "", ""
    for frame, _ in walk_tb(error.__traceback__):
        module = str(frame.f_globals.get("__name__"))
        if module.startswith("hyrfpack.ops."):
            package, kernel = module.split(".")[2], ""
        elif package and not kernel and module.partition(".")[0] == "triton":
            kernel = getattr(frame.f_locals.get("self"), "__name__", "of unknown name")
    if not kernel:
        return None
    return f"the GPU kernel {kernel} of hyrfpack.ops.{package} cannot be compiled or launched ({_find_reason(error)})"


def _find_reason(error: BaseException) -> str:
    """Return the line of an error's message that says most; Triton quotes source code before its own message."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()] or [type(error).__name__]
    return lines[-1 if re.match(r"at \d+:\d+:", lines[0]) else 0][:MAX_REASON_LENGTH]

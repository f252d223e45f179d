"""Run cases of the self-test; started as a child process by `hyrfpack.self_test.run`.

python -m hyrfpack.self_test.worker gpu cuda:0 mlp rasterize
"""

from __future__ import annotations

import subprocess
import sys
import sysconfig
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path

import torch

from hyrfpack.errors import short_reason
from hyrfpack.out_of_memory import describe_out_of_memory
from hyrfpack.parallel.child_items import Row, describe_exception, run_items
from hyrfpack.self_test.cases import list_self_test_cases
from hyrfpack.self_test.check import check_case
from hyrfpack.self_test.run import DEVICE_ITEM, LAUNCH_ITEM

INSTALL_FIX = "install a C compiler such as gcc, and the headers of this Python (often the package python3-dev)"
CACHE_FIX = "set TRITON_CACHE_DIR to a folder that can be written"


def run_cases(implementation: str, device: torch.device, names: Sequence[str]) -> int:
    """Test an implementation on a device in the cases of these names; return the exit code."""

    def run(name: str) -> Iterator[Row]:
        if name == DEVICE_ITEM:
            torch.ones(1, device=device).item()
        elif name == LAUNCH_ITEM:
            yield from _check_launch(device)
        else:
            yield check_case(list_self_test_cases()[name], implementation, device)

    if device.type == "cuda" and device.index is not None:
        with suppress(RuntimeError):  # The first item meets the same error and reports it.
            torch.cuda.set_device(device)

    return run_items(run, names, lambda: is_usable(device), _describe_failure)


def is_usable(device: torch.device) -> bool:
    """Return whether the device still works; after an illegal memory access it does not, for the whole process."""
    try:
        torch.ones(1, device=device).item()
    except RuntimeError:
        return False
    return True


def _check_launch(device: torch.device) -> Iterator[Row]:
    """Yield a row with what to install or to set as "fix" if the simplest kernel fails, unless memory ran out."""
    from hyrfpack.self_test.simplest_kernel import launch_simplest_kernel

    try:
        launch_simplest_kernel(device)
    except Exception as error:
        if describe_out_of_memory(error) is not None:
            raise
        note, fix = explain_launch_failure(error)
        yield {"status": "failed", "note": note, "fix": fix}


def explain_launch_failure(error: Exception) -> tuple[str, str]:
    """Return why the simplest kernel failed, in short, and what to install or to set."""
    if isinstance(error, subprocess.CalledProcessError):  # Triton compiles its launcher in C.
        has_headers = Path(sysconfig.get_path("include"), "Python.h").exists()
        missing = "" if has_headers else "; Python.h is missing"
        return f"{Path(error.cmd[0]).name} ended with exit code {error.returncode}{missing}", INSTALL_FIX
    return short_reason(error), CACHE_FIX if isinstance(error, OSError) else INSTALL_FIX


def _describe_failure(error: Exception) -> Row:
    if (problem := describe_out_of_memory(error)) is not None:
        return {"status": "failed", "note": problem, "is_temporary": True}
    return {"status": "failed", "note": describe_exception(error)}


if __name__ == "__main__":
    sys.exit(run_cases(sys.argv[1], torch.device(sys.argv[2]), sys.argv[3:]))

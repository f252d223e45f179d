"""Run cases of the self-test; started as a child process by `hyrfpack.self_test.run`.

python -m hyrfpack.self_test.worker gpu cuda:0 mlp rasterize
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from contextlib import suppress

import torch

from hyrfpack.parallel.child_items import Row, describe_exception, run_items
from hyrfpack.self_test.cases import self_test_cases
from hyrfpack.self_test.check import check_case
from hyrfpack.self_test.run import DEVICE_ITEM


def run_cases(implementation: str, device: torch.device, names: Sequence[str]) -> int:
    """Test an implementation on a device in the cases of these names; return the exit code."""

    def run(name: str) -> Iterator[Row]:
        if name == DEVICE_ITEM:
            torch.ones(1, device=device).item()
            return
        yield check_case(self_test_cases()[name], implementation, device)

    if device.type == "cuda":
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


def _describe_failure(error: Exception) -> Row:
    return {"status": "failed", "note": describe_exception(error)}


if __name__ == "__main__":
    sys.exit(run_cases(sys.argv[1], torch.device(sys.argv[2]), sys.argv[3:]))

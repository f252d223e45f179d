"""A plugin of pytest that ends a worker of xdist whose GPU context is broken; xdist then starts a new worker.

After an illegal memory access every later call on the GPU fails in that process. Without this plugin all tests that the
worker still has to run would fail, too.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Generator

import pytest


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """End the process after a test that has broken the GPU; xdist reports that test as failed."""
    report = yield
    if call.excinfo is not None and "PYTEST_XDIST_WORKER" in os.environ and is_gpu_broken():
        os.write(2, f"the GPU is unusable after {item.nodeid}: {call.excinfo.exconly()}\n".encode())
        os._exit(1)
    return report


def is_gpu_broken() -> bool:
    """Return whether this process has used a GPU that no longer works."""
    torch = sys.modules.get("torch")
    if torch is None or not torch.cuda.is_available():
        return False
    from hyrfpack.self_test.worker import is_usable

    return not is_usable(torch.device("cuda"))

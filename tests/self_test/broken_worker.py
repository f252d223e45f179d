"""A child of the self-test whose kernels are broken on purpose, run in Triton's interpreter on the CPU.

python tests/self_test/broken_worker.py '{"contract": "nan"}' gpu cpu CASE ...
"""

from __future__ import annotations

import ctypes
import json
import os
import signal
import sys
import time
from pathlib import Path
from pkgutil import resolve_name
from typing import Any
from unittest import mock

sys.path.insert(0, str(Path(__file__).parents[1]))

import torch
from interpreter import speed_up_interpreter

from hyrfpack.self_test import worker

# A function that starts the kernels of each operation, and one that starts those of a gradient.
ENTRY_POINTS = {
    "activate_geometry gradient": ("hyrfpack.ops.activate.gpu:_Activate", "backward"),
    "adam_step": ("hyrfpack.ops.adam.gpu", "adam_step"),
    "composite": ("hyrfpack.ops.composite.gpu", "composite"),
    "contract": ("hyrfpack.ops.contraction.gpu", "contract"),
    "encode_views": ("hyrfpack.ops.shade.gpu_directions", "encode_views"),
    "shade": ("hyrfpack.ops.shade.gpu", "shade"),
}


def find_results(value: Any) -> list[torch.Tensor]:
    """Return the tensors among the results of an entry point."""
    values = [value] if isinstance(value, torch.Tensor) else value
    return [value for value in values if isinstance(value, torch.Tensor)]


def break_entry_point(name: str, how: str) -> None:
    """Replace an entry point by one that is broken in one of the ways a kernel can be."""
    owner_name, function_name = ENTRY_POINTS[name]
    owner = resolve_name(owner_name)
    original = getattr(owner, function_name)

    def broken(*args: Any, **kwargs: Any) -> Any:
        if how == "does not compile":
            raise RuntimeError("PassManager::run failed\nmore")
        if how == "is killed":
            os.kill(os.getpid(), signal.SIGKILL)
        if how == "crashes":
            print("last words", flush=True)
            ctypes.string_at(0)
        if how == "hangs":
            time.sleep(600)
        result = original(*args, **kwargs)
        for tensor in find_results(result):
            if how == "nan":
                tensor.data.view(-1)[-1] = torch.nan
            elif how == "wrong":
                tensor.data.view(-1)[::2] *= 1.5
        if how == "illegal access":
            worker.is_usable = lambda device: False
            raise RuntimeError("CUDA error: an illegal memory access was encountered")
        return result

    mock.patch.object(owner, function_name, staticmethod(broken) if isinstance(owner, type) else broken).start()


if __name__ == "__main__":
    speed_up_interpreter()
    for entry_point, way in json.loads(sys.argv[1]).items():
        if entry_point == "device":
            raise SystemExit("CUDA-capable device(s) is/are busy or unavailable")
        break_entry_point(entry_point, way)
    sys.exit(worker.run_cases(sys.argv[2], torch.device(sys.argv[3]), sys.argv[4:]))

"""Runs only the last programs of each launch in Triton's interpreter, on tensors of which only used pages need memory.

So a call for millions of Gaussians takes a second, and its programs have the largest numbers and offsets.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import product
from typing import Any
from unittest import mock

import numpy as np
import torch
from torch import Tensor
from triton.runtime import interpreter

# Along an axis with more programs than this, such as that of the Gaussians, only the last ones run.
MAX_PROGRAMS_PER_AXIS = 32
LAST_PROGRAMS = 4


def lazy_zeros(*shape: Any, dtype: torch.dtype = torch.float32, **_: Any) -> Tensor:
    """Return zeros whose memory the system provides page by page, when a page is first written.

    They lie in a sparse file, which may be larger than all memory.
    """
    sizes = tuple(shape[0]) if shape and not isinstance(shape[0], int) else shape
    count = int(np.prod(sizes, dtype=np.int64))
    with tempfile.NamedTemporaryFile(prefix="hyrfpack-lazy-") as file:
        size = max(count, 1) * dtype.itemsize
        memory = torch.from_file(file.name, shared=True, size=size, dtype=torch.uint8).view(dtype)
    return memory[:count].view(sizes)


def _lazy_like(other: Tensor, *, dtype: torch.dtype | None = None, **_: Any) -> Tensor:
    return lazy_zeros(*other.shape, dtype=dtype or other.dtype)


def _lazy_new(other: Tensor, *shape: Any, dtype: torch.dtype | None = None, **_: Any) -> Tensor:
    return lazy_zeros(*shape, dtype=dtype or other.dtype)


@contextmanager
def run_last_programs() -> Iterator[None]:
    """Run only the last programs of each launch in this context, and make uninitialised memory lazy."""
    launch = interpreter.GridExecutor.__call__
    builder = interpreter.InterpreterBuilder
    set_grid, set_program = builder.set_grid_dim, builder.set_grid_idx
    grid: tuple[int, ...] = (1, 1, 1)
    programs: list[tuple[int, ...]] = []

    def run(executor: Any, *args: Any, **kwargs: Any) -> Any:
        nonlocal grid, programs
        grid = (*executor.grid, 1, 1)[:3]
        axes = [range(_first(size), size) for size in grid]
        programs = list(product(*axes))
        executor.grid = (len(programs),)
        return launch(executor, *args, **kwargs)

    with (
        mock.patch.object(interpreter.GridExecutor, "__call__", run),
        mock.patch.object(builder, "set_grid_dim", lambda self, *_: set_grid(self, *grid)),
        mock.patch.object(builder, "set_grid_idx", lambda self, number, *_: set_program(self, *programs[number])),
        mock.patch.multiple(torch, empty=lazy_zeros, empty_like=_lazy_like, zeros=lazy_zeros, zeros_like=_lazy_like),
        mock.patch.multiple(Tensor, new_empty=_lazy_new, new_zeros=_lazy_new),
    ):
        yield


def _first(size: int) -> int:
    return size - LAST_PROGRAMS if size > MAX_PROGRAMS_PER_AXIS else 0

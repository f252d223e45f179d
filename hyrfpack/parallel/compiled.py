"""Compile CPU kernels, and cache them on disk where this is possible."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numba
from numba.core.caching import FunctionCache


class _TolerantCache(FunctionCache):
    """Numba's disk cache of one function, which ignores write errors: the compiled kernel is already in memory."""

    def save_overload(self, sig, data):
        try:
            super().save_overload(sig, data)
        except OSError:
            # Numba writes the index before the code. The index may now name a file of an older source, which would be
            # loaded by the next process, so the index is removed.
            with suppress(OSError):
                Path(self._cache_file._index_path).unlink()


def can_cache_kernels() -> bool:
    """Return whether Numba finds a writable folder that keeps compiled kernels between processes."""
    try:
        _TolerantCache(can_cache_kernels)
    except RuntimeError:
        return False
    return True


def compiled(**options: Any) -> Callable[[Callable], Callable]:
    """Decorate a function with `numba.njit(nogil=True, **options)` and cache its machine code on disk.

    If nothing can be cached (the disk is full or no folder is writable), each process compiles the kernel again.
    """

    def decorate(function: Callable) -> Callable:
        kernel = numba.njit(nogil=True, **options)(function)
        with suppress(RuntimeError):  # Numba raises this if it finds no writable folder.
            kernel._cache = _TolerantCache(function)
        return kernel

    return decorate

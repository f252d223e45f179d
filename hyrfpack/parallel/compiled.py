"""Compile CPU kernels, and cache them on disk where this is possible."""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import numba
from numba.core.caching import FunctionCache


class _TolerantCache(FunctionCache):
    """Numba's disk cache of one function, for the sources of its whole package, which ignores write errors.

    Machine code contains the constants and functions that a kernel takes from other modules, of which Numba checks
    none. Kernels therefore take them from their own package: that of the first two names of their module, such as
    `hyrfpack.ops`.

    Write errors can be ignored because the compiled kernel is already in memory.
    """

    def __init__(self, function):
        super().__init__(function)
        if not hasattr(self._cache_file, "_source_stamp"):
            raise RuntimeError("this Numba stamps cached kernels in another way, so stale ones would not be detected")
        package = ".".join(function.__module__.split(".")[:2])
        self._cache_file._source_stamp = self._cache_file._source_stamp, _source_digest(package)

    def save_overload(self, sig, data):
        try:
            super().save_overload(sig, data)
        except OSError:
            # Numba writes the index before the code. The index may now name a file of an older source, which would be
            # loaded by the next process, so the index is removed.
            with suppress(OSError):
                Path(self._cache_file._index_path).unlink()


@cache
def _source_digest(package: str) -> str:
    """Return a digest of this file and all Python files of an imported package, as they were at the first call."""
    digest = hashlib.sha256(Path(__file__).read_bytes())
    for folder in getattr(sys.modules.get(package), "__path__", ()):  # A module that is no package has none.
        for path in sorted(Path(folder).rglob("*.py")):
            with suppress(OSError):  # Lock files of editors are links to nothing.
                digest.update(path.read_bytes())
    return digest.hexdigest()


def can_cache_kernels() -> bool:
    """Return whether Numba finds a writable folder that keeps compiled kernels between processes."""
    try:
        _TolerantCache(can_cache_kernels)
    except RuntimeError:
        return False
    return True


def compiled(**options: Any) -> Callable[[Callable], Callable]:
    """Decorate a function with `numba.njit(nogil=True, **options)` and cache its machine code on disk.

    If nothing can be cached (the disk is full or no folder is writable), each process compiles the kernel again. A
    change of any Python file of its package makes the next process do so, too.
    """

    def decorate(function: Callable) -> Callable:
        kernel = numba.njit(nogil=True, **options)(function)
        with suppress(RuntimeError):  # There is no writable folder, or Numba has changed.
            kernel._cache = _TolerantCache(function)
        return kernel

    return decorate

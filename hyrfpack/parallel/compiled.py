"""Compiled kernels, kept on the disk where there is room for them."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numba
from numba.core.caching import FunctionCache


class _Cache(FunctionCache):
    """Numba's cache of one function, for which a full disk is no reason to stop: the kernel is in memory already."""

    def save_overload(self, sig, data):
        try:
            super().save_overload(sig, data)
        except OSError:
            # Numba writes the index before the code: it may name a file left by an older source, which would be run.
            with suppress(OSError):
                Path(self._cache_file._index_path).unlink()


def are_kept() -> bool:
    """Whether there is a folder that kernels can be kept in, from one process to the next."""
    try:
        _Cache(are_kept)
    except RuntimeError:
        return False
    return True


def compiled(**options: Any) -> Callable[[Callable], Callable]:
    """A decorator: `numba.njit(nogil=True, **options)`, with the machine code cached on the disk.

    Where nothing can be kept (disk full, no folder that may be written), the kernel is compiled anew by each process.
    """

    def decorate(function: Callable) -> Callable:
        kernel = numba.njit(nogil=True, **options)(function)
        with suppress(RuntimeError):  # no folder that may be written
            kernel._cache = _Cache(function)
        return kernel

    return decorate

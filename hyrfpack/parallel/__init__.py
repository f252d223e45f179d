"""Parallel work: compiled CPU kernels, the thread pool that runs them, and groups of processes.

Nothing here knows what is computed.
"""

from __future__ import annotations

from functools import cache


@cache
def has_numba() -> bool:
    """Return whether Numba can be imported, and so compile kernels.

    Only importing it shows whether it supports the installed version of numpy.
    """
    try:
        import numba  # noqa: F401
    except (ImportError, OSError):  # Numba rejects a numpy that is too new, and its compiler library may fail to load
        return False
    return True

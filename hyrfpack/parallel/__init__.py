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
    except Exception:  # with a numpy that is too new or a broken compiler library, it raises errors of many types
        return False
    return True

"""What work is shared among: compiled CPU kernels, the threads that run them, and processes. Knows nothing of what is
computed."""

from __future__ import annotations

from functools import cache


@cache
def has_numba() -> bool:
    """Whether kernels can be compiled: Numba is there, and takes the numpy that is there, which importing it tells."""
    try:
        import numba  # noqa: F401
    except (ImportError, OSError):  # it refuses a numpy that is too new; its compiler is a library that may not load
        return False
    return True

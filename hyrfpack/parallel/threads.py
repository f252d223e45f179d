"""The number of threads to use, without importing torch."""

from __future__ import annotations

import os


def thread_count() -> int:
    """Return the number of threads to use: HYRFPACK_THREADS, or else the number of available cores."""
    requested = os.environ.get("HYRFPACK_THREADS", "")
    is_number = requested.isascii() and requested.isdigit()
    return (int(requested) if is_number else 0) or available_cores()


def available_cores() -> int:
    """Return the number of CPU cores that this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1

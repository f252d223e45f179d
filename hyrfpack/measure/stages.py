"""Adds up the wall time of stages."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def add_seconds(seconds: dict[str, float], stage: str) -> Iterator[None]:
    """Add the wall time of the enclosed block to `seconds[stage]`."""
    start = time.perf_counter()
    yield
    seconds[stage] = seconds.get(stage, 0.0) + time.perf_counter() - start

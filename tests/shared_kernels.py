"""Let one of several test workers compile a kernel while the others wait for its machine code.

In a fresh clone all workers need the same kernels at the same time. Without this, each of them compiles all kernels,
which takes each of them a minute.
"""

from __future__ import annotations

import time
from contextlib import suppress
from typing import Any

MAX_WAIT_SECONDS = 60
POLL_SECONDS = 0.05


def compile_kernels_once() -> None:
    """Lock the source file of a kernel from the miss in the cache on disk until its machine code is there."""
    try:
        import fcntl

        from hyrfpack.parallel.compiled import _TolerantCache
    except ImportError:
        return
    load, save, held = _TolerantCache.load_overload, _TolerantCache.save_overload, {}

    def release(path: str) -> None:
        file, uses = held.pop(path)
        if uses > 1:  # a kernel that calls another one of its module
            held[path] = file, uses - 1
        else:
            file.close()

    def load_or_lock(self: Any, sig: Any, target_context: Any) -> Any:
        found, path = load(self, sig, target_context), self._py_func.__code__.co_filename
        if found is not None:
            return found
        if path in held:
            held[path] = held[path][0], held[path][1] + 1
            return None
        file = open(path, "rb")
        ends = time.monotonic() + MAX_WAIT_SECONDS
        while time.monotonic() < ends:
            with suppress(BlockingIOError):
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            time.sleep(POLL_SECONDS)
        held[path] = file, 1
        found = load(self, sig, target_context)
        if found is not None:
            release(path)
        return found

    def save_and_release(self: Any, sig: Any, data: Any) -> None:
        try:
            save(self, sig, data)
        finally:
            if (path := self._py_func.__code__.co_filename) in held:
                release(path)

    _TolerantCache.load_overload, _TolerantCache.save_overload = load_or_lock, save_and_release

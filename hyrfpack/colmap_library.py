"""Import of pycolmap, which reads and writes COLMAP reconstructions."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType

from hyrfpack.errors import needs_package


def load_pycolmap(task: str) -> ModuleType:
    """Import pycolmap and return it; `keep_sigterm_handler` says what its import would change.

    Args:
        task: what needs the package, as in `needs_package`.

    Raises:
        HyrfError: pycolmap is not installed.
    """
    if sys.modules.get("pycolmap") is not None:  # the import system stores None for a module that may not be imported
        return sys.modules["pycolmap"]
    with needs_package(task), keep_sigterm_handler():
        import pycolmap
    return pycolmap


@contextmanager
def keep_sigterm_handler() -> Iterator[None]:
    """Keep the handler of SIGTERM while a block imports pycolmap, if it runs in the main thread.

    The import installs a handler that prints a C++ stack trace before the process ends. Python does not see such
    handlers, so the disposition that Python knows is set again.
    """
    try:
        yield
    finally:
        # Only the main thread can set signal handlers.
        if threading.current_thread() is threading.main_thread():
            handler = signal.getsignal(signal.SIGTERM)
            if handler is not None:  # None is a handler that was not installed from Python
                signal.signal(signal.SIGTERM, handler)

"""Import of pycolmap, which reads and writes COLMAP reconstructions."""

from __future__ import annotations

import signal
import sys
import threading
from types import ModuleType

from hyrfpack.errors import needs_package


def load_pycolmap(task: str) -> ModuleType:
    """Import pycolmap and return it.

    Its import installs a handler of SIGTERM that prints a C++ stack trace before the process ends. Python does not see
    such handlers, so the disposition that Python knows is set again.

    Args:
        task: what needs the package, as in `needs_package`.

    Raises:
        HyrfError: pycolmap is not installed.
    """
    is_first_import = "pycolmap" not in sys.modules
    with needs_package(task):
        import pycolmap
    # Only the main thread can set signal handlers.
    if is_first_import and threading.current_thread() is threading.main_thread():
        handler = signal.getsignal(signal.SIGTERM)
        if handler is not None:  # None is a handler that was not installed from Python
            signal.signal(signal.SIGTERM, handler)
    return pycolmap

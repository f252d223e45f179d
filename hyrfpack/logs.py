"""Limits on what other code logs."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def log_only_errors_of(package: str) -> Iterator[None]:
    """Log only errors of a package, and of the modules in it, while the block runs.

    Example:
        >>> import logging
        >>> with log_only_errors_of("matplotlib"):
        ...     logging.getLogger("matplotlib").isEnabledFor(logging.WARNING)
        False
    """
    logger = logging.getLogger(package)
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(level)

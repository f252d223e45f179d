"""Files appear whole or not at all."""

from __future__ import annotations

import contextlib
import errno
import os
import secrets
from pathlib import Path

from hyrfpack.errors import HyrfError


def write_atomic(path: str | os.PathLike[str], data: bytes | memoryview) -> None:
    """Put `data` at `path` in one step: at any moment, a crash included, readers find the old file or the new one.

    The bytes go to a temporary file in the same folder, are forced to the disk, and only then take the name. A link
    at `path` stays and its target is replaced. When anything fails, an interrupt included, the old file is untouched
    and the temporary file is removed.

    Raises:
        HyrfError: the folder is missing, not writable or full, or `path` is a folder.
    """
    target = Path(os.path.realpath(path))
    temporary = target.with_name(f".hyrfpack-{secrets.token_hex(6)}.tmp")
    try:
        # Opened by hand rather than through tempfile, which would make the file private (mode 0600).
        with open(temporary, "xb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, target)
    except OSError as error:
        raise HyrfError(_explain(path, target, memoryview(data).nbytes, error)) from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
    _sync_folder(target.parent)


def _sync_folder(folder: Path) -> None:
    """Make the new name survive a power cut. Windows and some network folders cannot; the file is whole there too."""
    with contextlib.suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def _explain(path: str | os.PathLike[str], target: Path, length: int, error: OSError) -> str:
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return f"{path}: the disk is full; free {length:,} bytes and try again, nothing was changed"
    if target.is_dir():
        return f"{path}: this is a folder; name a file in it"
    if not target.parent.is_dir():
        return f"{path}: there is no folder '{target.parent}'; make it first"
    return f"{path}: the file cannot be written ({error.strerror or error}); choose another place or mend this one"

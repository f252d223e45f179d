"""The user's folder for files that hyrfpack can make again."""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path

from hyrfpack.errors import HyrfError


def open_cache_folder(name: str) -> Path:
    """Create and return a cache folder of this user, below the temporary folder if the home is not writable.

    Args:
        name: what the folder is for, such as "archives".

    Raises:
        HyrfError: neither place is writable.
    """
    home = os.path.expanduser("~")
    default_caches = {"darwin": f"{home}/Library/Caches", "win32": os.environ.get("LOCALAPPDATA", home)}
    caches = os.environ.get("XDG_CACHE_HOME", "")
    if not os.path.isabs(caches):  # The specification of the variable says that a relative path is ignored.
        caches = default_caches.get(sys.platform, f"{home}/.cache")
    user = os.getuid() if hasattr(os, "getuid") else "user"
    # Without a known home, expanduser returns "~", which would be a folder in the working directory.
    homes = [Path(caches, "hyrfpack")] if os.path.isabs(caches) else []
    for own_folder in (*homes, Path(tempfile.gettempdir(), f"hyrfpack-{user}")):
        folder = own_folder / name
        try:
            own_folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            # In the shared temporary folder, another user may have created it.
            if hasattr(os, "getuid") and own_folder.stat().st_uid != os.getuid():
                continue
            folder.mkdir(mode=0o700, exist_ok=True)
            if os.access(folder, os.W_OK | os.X_OK):
                return folder
        except OSError:
            continue
    raise HyrfError(
        f"{caches}: no file can be made in this folder",
        fix="set XDG_CACHE_HOME to a folder that is writable",
    )

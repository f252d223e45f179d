"""Which paths name splats: the command line asks before it loads a reader, and torch with it."""

from __future__ import annotations

import json
import os
from pathlib import Path

SPLATS_SUFFIXES = (".ply", ".splat", ".spz", ".sog")  # of the files that `hyrfpack.splats.files.read_splats` takes
SOG_META_NAME = "meta.json"  # of a SOG that is not bundled: a folder of pictures, and this beside them


def is_splats(path: str | os.PathLike[str]) -> bool:
    """Return whether a path names 3D Gaussians of another program.

    It does if it has one of SPLATS_SUFFIXES, or is the folder, or the meta.json, of a SOG that is not bundled.
    """
    path = Path(path)
    return path.suffix.lower() in SPLATS_SUFFIXES or path.name == SOG_META_NAME or _is_sog_folder(path)


def _is_sog_folder(path: Path) -> bool:
    """Whether a meta.json in the folder speaks of positions, as that of a SOG does; other programs write such files."""
    try:
        content = json.loads((path / SOG_META_NAME).read_bytes())
    except (OSError, ValueError, RecursionError):
        return False
    return isinstance(content, dict) and "means" in content


def splats_folder(path: str | os.PathLike[str]) -> Path | None:
    """Return the folder of a SOG that is not bundled, named by itself or by its meta.json; None for a file."""
    path = Path(path)
    folder = path.parent if path.name == SOG_META_NAME else path
    return folder if folder.is_dir() else None


def bytes_on_disk(path: str | os.PathLike[str]) -> int:
    """Return the size of a file of splats, or of all files in the folder of a SOG."""
    folder = splats_folder(path)
    if folder is None:
        return os.path.getsize(path)
    return sum(file.stat().st_size for file in folder.iterdir() if file.is_file())

"""Recognition of splats by their paths. It imports no torch, so that the command line starts fast."""

from __future__ import annotations

import json
import os
from pathlib import Path

SPLATS_SUFFIXES = (".ply", ".spz", ".splat", ".sog")  # must equal READABLE_ENDINGS of `hyrfpack.splats.files`
SOG_META_NAME = "meta.json"


def is_splats(path: str | os.PathLike[str]) -> bool:
    """Return whether a path names 3D Gaussians of another program.

    Such a path ends in one of SPLATS_SUFFIXES, or is the folder or the meta.json of an unbundled SOG.
    """
    path = Path(path)
    return path.suffix.lower() in SPLATS_SUFFIXES or is_sog_folder(path.parent if path.name == SOG_META_NAME else path)


def is_sog_folder(path: Path) -> bool:
    """Return whether a path is a folder with the meta.json of a SOG; other programs use that name, too."""
    try:
        content = json.loads((path / SOG_META_NAME).read_bytes())
    except (OSError, ValueError, RecursionError):
        return False
    return isinstance(content, dict) and "means" in content


def find_sog_folder(path: str | os.PathLike[str]) -> Path | None:
    """Return the folder of an unbundled SOG, given the folder or its meta.json; None for a file."""
    path = Path(path)
    folder = path.parent if path.name == SOG_META_NAME else path
    return folder if os.path.isdir(folder) else None

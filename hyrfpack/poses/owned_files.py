"""Keep a record of the files that an estimation wrote into a scene's folder; only these may be removed later."""

from __future__ import annotations

import json
import os
from collections.abc import Collection
from contextlib import suppress
from pathlib import Path
from typing import Any

OWNED_FOLDERS = ("images", "masks")  # an estimation writes photos and masks into these folders of a scene
REPORT_NAME = "poses.json"

OwnedFiles = dict[str, int]  # size in bytes of each file, by its path relative to the scene


def read_report(scene: Path) -> dict[str, Any] | None:
    """Return the report of an estimation in a scene's folder; None if it is missing or of another program."""
    with suppress(OSError, ValueError):
        report = json.loads((scene / REPORT_NAME).read_bytes())
        if isinstance(report, dict) and {"mapper", "registered", "made"} <= report.keys():
            return report
    return None


def list_files(folder: Path, name: str) -> OwnedFiles:
    """List the files in a folder that becomes the folder `name` of the scene, with their sizes in bytes."""
    files = (path for path in folder.rglob("*") if path.is_file())
    return {f"{name}/{path.relative_to(folder).as_posix()}": path.stat().st_size for path in files}


def unchanged_files(scene: Path, owned: Any) -> OwnedFiles:
    """Return the files of a record that are still in the scene with their recorded size.

    The record is not trusted: it may be forged, or come from another folder. Files outside OWNED_FOLDERS of the scene
    are never returned.
    """
    found: OwnedFiles = {}
    root = scene.resolve()
    for name, size in owned.items() if isinstance(owned, dict) else ():
        path = scene / name
        with suppress(OSError, ValueError):
            inside = path.resolve() == root / name and name.split("/")[0] in OWNED_FOLDERS
            if inside and path.is_file() and path.stat().st_size == size:
                found[name] = size
    return found


def remove_files(scene: Path, owned: OwnedFiles, keep: Collection[Path]) -> None:
    """Remove owned files, except those in `keep` (resolved paths), and the folders that become empty."""
    root = scene.resolve()
    for name in owned:
        if root / name not in keep:
            (scene / name).unlink(missing_ok=True)
    for parent in sorted({parent for name in owned for parent in (scene / name).parents}, reverse=True):
        if parent != scene and scene in parent.parents:
            with suppress(OSError):  # a folder with other files stays
                os.rmdir(parent)


def has_only(scene: Path, name: str, owned: OwnedFiles) -> bool:
    """Return whether a folder of the scene is not a link and would be empty after its owned files are removed."""
    folder = scene / name
    if folder.is_symlink() or not folder.is_dir():
        return False
    expected = {scene / file for file in owned}
    expected |= {parent for file in expected for parent in file.parents}
    return expected.issuperset(folder.rglob("*"))

"""Keep a record of the files that an estimation wrote into a scene's folder; only these may be removed later."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Collection
from contextlib import suppress
from pathlib import Path
from typing import Any

OWNED_FOLDERS = ("images", "masks")  # an estimation writes photos and masks into these folders of a scene
REPORT_NAME = "poses.json"

# The files of the COLMAP model, which reports of earlier versions do not list.
MODEL_FILES = frozenset(f"sparse/0/{table}.bin" for table in ("cameras", "frames", "images", "points3D", "rigs"))
IGNORED_NAMES = frozenset((".DS_Store", "Thumbs.db", "desktop.ini"))  # File managers write these into any folder.

# By the path relative to the scene: size in bytes, time of modification in nanoseconds, and digest. Reports of earlier
# versions have the size alone.
OwnedFiles = dict[str, Any]


def read_report(scene: Path) -> dict[str, Any] | None:
    """Return the report of an estimation in a scene's folder; None if it is missing or of another program."""
    with suppress(OSError, ValueError):
        report = json.loads((scene / REPORT_NAME).read_bytes())
        if isinstance(report, dict) and {"mapper", "registered", "made"} <= report.keys():
            return report
    return None


def list_files(folder: Path, name: str) -> OwnedFiles:
    """List the files in a folder that becomes the folder `name` of the scene, with their states."""
    files = (path for path in folder.rglob("*") if path.is_file())
    return {f"{name}/{path.relative_to(folder).as_posix()}": _state(path) for path in files}


def _state(path: Path) -> list:
    """Return size, time of modification and digest of a file."""
    status = path.stat()
    return [status.st_size, status.st_mtime_ns, hash_file(path)]


def hash_file(path: Path) -> str:
    """Return the SHA-1 digest of a file's bytes."""
    return hashlib.sha1(path.read_bytes(), usedforsecurity=False).hexdigest()


def _is_unchanged(path: Path, recorded: Any) -> bool:
    """Return whether a file has the recorded state, or only another time of modification, as a copy has."""
    status = path.stat()
    if isinstance(recorded, int):
        return status.st_size == recorded
    size, modified, digest = recorded
    return status.st_size == size and (status.st_mtime_ns == modified or hash_file(path) == digest)


def unchanged_files(scene: Path, owned: Any) -> OwnedFiles:
    """Return the files of a record that are still in the scene, unchanged.

    The record is not trusted: it may be forged, or come from another folder. Files outside OWNED_FOLDERS of the scene
    are never returned.
    """
    unchanged: OwnedFiles = {}
    root = scene.resolve()
    for name, state in owned.items() if isinstance(owned, dict) else ():
        path = scene / name
        with suppress(OSError, TypeError, ValueError):
            inside = path.resolve() == root / name and name.split("/")[0] in OWNED_FOLDERS
            if inside and path.is_file() and _is_unchanged(path, state):
                unchanged[name] = state
    return unchanged


def find_foreign_model_file(scene: Path, report: dict[str, Any]) -> str | None:
    """Return the name of a file below `sparse` that the estimation of a report did not write; None if there is none."""
    recorded = report.get("model_files")
    for path in sorted(path for path in (scene / "sparse").rglob("*") if path.is_file()):
        name = path.relative_to(scene).as_posix()
        is_own = name in MODEL_FILES
        if isinstance(recorded, dict):
            is_own = False
            with suppress(TypeError, ValueError):
                is_own = name in recorded and _is_unchanged(path, recorded[name])
        if not is_own and path.name not in IGNORED_NAMES:
            return name
    return None


def remove_files(scene: Path, owned: OwnedFiles, keep: Collection[Path]) -> None:
    """Remove owned files, except those in `keep` (resolved paths), and the folders that become empty.

    A folder with nothing but files of IGNORED_NAMES counts as empty.
    """
    root = scene.resolve()
    for name in owned:
        if root / name not in keep:
            (scene / name).unlink(missing_ok=True)
    for parent in sorted({parent for name in owned for parent in (scene / name).parents}, reverse=True):
        if parent != scene and scene in parent.parents:
            remove_empty_folder(parent)


def remove_empty_folder(folder: Path) -> None:
    """Remove a folder that has at most files of IGNORED_NAMES; any other stays."""
    with suppress(OSError):
        names = os.listdir(folder)
        if IGNORED_NAMES.issuperset(names):
            for name in names:
                (folder / name).unlink()
            os.rmdir(folder)


def has_only(scene: Path, name: str, owned: OwnedFiles) -> bool:
    """Return whether a folder of the scene is no link, and `remove_files` of the owned files would empty it."""
    folder = scene / name
    if folder.is_symlink() or not folder.is_dir():
        return False
    expected = {scene / file for file in owned}
    expected |= {parent for file in expected for parent in file.parents}
    return all(path in expected or path.name in IGNORED_NAMES for path in folder.rglob("*"))

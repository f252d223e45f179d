"""Which files of a scene's folder are of our making: these alone may be removed, and none else."""

from __future__ import annotations

import json
import os
from collections.abc import Collection
from contextlib import suppress
from pathlib import Path
from typing import Any

FOLDERS = ("images", "masks")  # of a scene, that files are put into
REPORT = "poses.json"

Made = dict[str, int]  # bytes of each file, by its path below the scene


def read_report(scene: Path) -> dict[str, Any] | None:
    """The report of an estimation in a scene's folder; None where there is none, or a file of another program."""
    with suppress(OSError, ValueError):
        report = json.loads((scene / REPORT).read_bytes())
        if isinstance(report, dict) and {"mapper", "registered", "made"} <= report.keys():
            return report
    return None


def files_of(folder: Path, name: str) -> Made:
    """What is in a folder that becomes the scene's folder `name`."""
    files = (path for path in folder.rglob("*") if path.is_file())
    return {f"{name}/{path.relative_to(folder).as_posix()}": path.stat().st_size for path in files}


def still_there(scene: Path, made: Any) -> Made:
    """What a record lists that lies in the scene as it was made. The record may be of a folder that was moved here, or
    forged: nothing outside the scene's own folders is among it."""
    found: Made = {}
    real = scene.resolve()
    for name, size in made.items() if isinstance(made, dict) else ():
        path = scene / name
        with suppress(OSError, ValueError):
            inside = path.resolve() == real / name and name.split("/")[0] in FOLDERS
            if inside and path.is_file() and path.stat().st_size == size:
                found[name] = size
    return found


def remove(scene: Path, made: Made, read: Collection[Path]) -> None:
    """Remove files of our making and the folders that they leave empty, but for those that are `read` (resolved)."""
    real = scene.resolve()
    for name in made:
        if real / name not in read:
            (scene / name).unlink(missing_ok=True)
    for parent in sorted({parent for name in made for parent in (scene / name).parents}, reverse=True):
        if parent != scene and scene in parent.parents:
            with suppress(OSError):  # there are other files in it
                os.rmdir(parent)


def are_all(scene: Path, name: str, made: Made) -> bool:
    """Whether a folder of the scene is empty once files of our making are removed, and a real folder."""
    folder = scene / name
    if folder.is_symlink() or not folder.is_dir():
        return False
    ours = {scene / file for file in made}
    ours |= {parent for file in ours for parent in file.parents}
    return ours.issuperset(folder.rglob("*"))

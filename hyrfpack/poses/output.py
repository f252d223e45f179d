"""The scene's folder: what is in progress lies in a folder in it, and takes its place when all is done."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import shutil
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from hyrfpack.atomic import check_writable, write_atomic
from hyrfpack.errors import HyrfDataError, HyrfError
from hyrfpack.outputs import COLMAP_MODEL_FOLDERS, COLMAP_TABLE_NAMES, PICTURE_SUFFIXES, POSE_FILE_NAMES
from hyrfpack.poses.made import FOLDERS, REPORT, Made, are_all, files_of, read_report, remove, still_there

_VERSION = 4  # of what is kept on the way; older products are made anew
_FINGERPRINT = "fingerprint"  # of what is made from which photos


class Output:
    """What one estimation puts into a scene's folder.

    Attributes:
        scene: the folder.
        work: the folder in it of products in progress.
        read: files that the estimation reads, resolved: none of them is removed.
    """

    def __init__(self, scene: Path) -> None:
        self.scene = scene
        self.work = scene / ".poses"
        self.read: frozenset[Path] = frozenset()

    def check_place(self, photos: Path) -> None:
        """Raises HyrfError: there are no photos, or the scene cannot be a folder."""
        if not photos.exists():
            raise HyrfDataError(f"{photos}: there is no such folder or video; name the one that holds the photos")
        if os.path.lexists(self.scene) and not self.scene.is_dir():
            raise HyrfError(f"{self.scene}: this is a file; name a folder for the scene")

    def check(self, photos: Path, overwrite: bool) -> None:
        """Raises HyrfError: there are poses or photos in the folder that may not be replaced, or it cannot be written.

        Args:
            photos: where these are.
            overwrite: poses of ours may be replaced.
        """
        there = set(os.listdir(self.scene))
        if there.intersection((*COLMAP_MODEL_FOLDERS, *COLMAP_TABLE_NAMES, *POSE_FILE_NAMES, "colmap")):
            if read_report(self.scene) is None:
                raise HyrfError(
                    f"{self.scene}: the folder has poses of another program, which are kept; train on them, or name "
                    "another folder"
                )
            if not overwrite:
                raise HyrfError(
                    f"{self.scene}: the folder has poses already; use them, or replace them with `overwrite=True`"
                )
        if not same(photos, self.scene) and any(name.lower().endswith(PICTURE_SUFFIXES) for name in there):
            raise HyrfError(f"{self.scene}: photos lie in this folder; name another for the scene")
        check_writable(self.scene)

    def check_free(self, name: str) -> None:
        """Raises HyrfError: in one of the scene's folders lies what is not of our making, or is read."""
        folder = self.scene / name
        ours = {made: size for made, size in self.made().items() if self.scene.resolve() / made not in self.read}
        if os.path.lexists(folder) and not are_all(self.scene, name, ours):
            raise HyrfError(
                f"{folder}: there are files that are not of these photos; name another folder for the scene, or "
                f"{self.scene} itself as that of the photos"
            )

    def reads(self, files: Collection[Path]) -> None:
        """Say what the estimation reads."""
        self.read = frozenset(path.resolve() for path in files)

    def claim(self, settings: list[Any]) -> bool:
        """Make the folder of products, or find that of the same call; returns whether it goes on.

        Args:
            settings: plain values, all that decides what comes of the files that are read.
        """
        states = [(str(path), path.stat().st_size, path.stat().st_mtime_ns) for path in sorted(self.read)]
        fingerprint = hashlib.sha256(json.dumps([_VERSION, settings, states]).encode()).hexdigest()
        kept = self.work / _FINGERPRINT
        if kept.is_file() and kept.read_text() == fingerprint:
            return True
        self.clear()
        self.work.mkdir()
        write_atomic(kept, fingerprint.encode())
        return False

    def make(self, name: str, fill: Callable[[Path], object], keep: bool = False) -> Path:
        """One of the scene's folders, in progress: filled whole or not at all, unless it is there.

        Args:
            name: of the folder.
            fill: called with the folder to fill.
            keep: what an interrupted call has filled in stays.
        """
        folder, unfinished = self.work / name, self.work / f"unfinished-{name}"
        if not folder.is_dir():
            if not keep:
                shutil.rmtree(unfinished, ignore_errors=True)
            unfinished.mkdir(exist_ok=True)
            try:
                fill(unfinished)
            except OSError:  # such as a full disk, which copies of many photos would keep full
                if not keep:
                    shutil.rmtree(unfinished, ignore_errors=True)
                raise
            os.replace(unfinished, folder)
        return folder

    def made(self) -> Made:
        """What earlier calls put into the scene's images/ and masks/."""
        return still_there(self.scene, (read_report(self.scene) or {}).get("made"))

    def put(self, model: Path, report: dict[str, Any]) -> None:
        """Bring photos, masks and model to their places.

        Old poses go first, so that they never lie beside new photos, and the report says what is ours before it is
        there: what is ours may be made anew.

        Args:
            model: the COLMAP model's folder.
            report: to be written, but for what was made.
        """
        old = self.made()
        new: Made = {}
        in_progress = [name for name in FOLDERS if (self.work / name).is_dir()]
        for name in in_progress:
            new |= files_of(self.work / name, name)
        replaced, unfinished = self.work / "replaced", self.work / "sparse"
        for folder in (replaced, unfinished):
            shutil.rmtree(folder, ignore_errors=True)
        if os.path.lexists(self.scene / "sparse"):
            os.replace(self.scene / "sparse", replaced)
        self._record(report, old | new)
        remove(self.scene, old, self.read)
        for name in in_progress:
            if (self.scene / name).is_dir():
                (self.scene / name).rmdir()
            os.replace(self.work / name, self.scene / name)
        self._record(report, self.made())
        unfinished.mkdir()
        os.replace(model, unfinished / "0")
        os.replace(unfinished, self.scene / "sparse")
        self.clear()

    def _record(self, report: dict[str, Any], made: Made) -> None:
        write_atomic(self.scene / REPORT, json.dumps(report | {"made": made}, indent=1).encode())

    def clear(self) -> None:
        """Remove products in progress."""
        shutil.rmtree(self.work, ignore_errors=True)

    def clear_if_bare(self) -> None:
        """Remove the folder of products if nothing is in progress in it."""
        if all(path.is_dir() or path.name == _FINGERPRINT for path in self.work.rglob("*")):
            self.clear()


def same(first: Path, second: Path) -> bool:
    """Whether two paths are of one place."""
    return first.resolve() == second.resolve()


@contextmanager
def disk_errors(out: Path) -> Iterator[None]:
    """What the disk refuses is one sentence; what is done is kept."""
    try:
        yield
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise HyrfError(
                f"{out}: the disk is full; free some space and run the same command again, which goes on here"
            ) from error
        if isinstance(error, FileNotFoundError):
            raise HyrfError(
                f"{error.filename or out}: was removed or moved meanwhile; put it back and run the same command again"
            ) from error
        raise HyrfError(
            f"{error.filename or out}: cannot be read or written ({error.strerror or error}); check the folder's "
            "permissions and the disk"
        ) from error

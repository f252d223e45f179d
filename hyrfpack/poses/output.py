"""Write a scene's folder: products are built in its sub-folder .poses and moved into place when all is done."""

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
from hyrfpack.poses.owned_files import (
    OWNED_FOLDERS,
    REPORT_NAME,
    OwnedFiles,
    find_foreign_model_file,
    has_only,
    list_files,
    read_report,
    remove_empty_folder,
    remove_files,
    unchanged_files,
)

_PRODUCTS_VERSION = 6  # products in progress of another version are discarded
_FINGERPRINT_NAME = "fingerprint"  # this file identifies the photos and settings of the products in progress


class SceneOutput:
    """The folder of a scene, into which one estimation writes.

    Attributes:
        scene: the folder.
        work: its sub-folder of products in progress.
        protected: resolved paths of files that the estimation reads and that are therefore never removed.
    """

    def __init__(self, scene: Path) -> None:
        self.scene = scene
        self.work = scene / ".poses"
        self.protected: frozenset[Path] = frozenset()

    def check_paths(self, photos: Path) -> None:
        """Check both paths. Raises HyrfError: the photos do not exist, or a file has the name of the scene's folder."""
        if not photos.exists():
            raise HyrfDataError(f"{photos}: there is no such folder or video", fix="name the folder or the video")
        if os.path.lexists(self.scene) and not self.scene.is_dir():
            raise HyrfError(f"{self.scene}: this is a file", fix="name a folder for the scene")

    def check_replaceable(self, photos: Path, overwrite: bool) -> None:
        """Check that the folder can be written and has nothing that may not be replaced.

        Args:
            photos: path of the photos.
            overwrite: poses that an earlier estimation wrote may be replaced.

        Raises:
            HyrfError: the folder has poses or photos that may not be replaced, or it cannot be written.
        """
        names = set(os.listdir(self.scene))
        if names.intersection((*COLMAP_MODEL_FOLDERS, *COLMAP_TABLE_NAMES, *POSE_FILE_NAMES, "colmap")):
            report = read_report(self.scene)
            if report is None:
                raise HyrfError(
                    f"{self.scene}: the folder has poses of another program, which are kept",
                    fix="train on them, or name another folder",
                )
            if not overwrite:
                raise HyrfError(
                    f"{self.scene}: the folder has poses already",
                    fix="use them, or replace them with `overwrite=True`",
                )
            if (foreign := find_foreign_model_file(self.scene, report)) is not None:
                raise HyrfError(
                    f"{self.scene / foreign}: this file would be removed, but no estimation of poses wrote it",
                    fix="move it elsewhere, or name another folder",
                )
        if not is_same_path(photos, self.scene) and any(name.lower().endswith(PICTURE_SUFFIXES) for name in names):
            raise HyrfError(f"{self.scene}: this folder holds photos", fix="name another folder for the scene")
        check_writable(self.scene)

    def check_free(self, name: str) -> None:
        """Check a sub-folder. Raises HyrfError: it has files that no estimation wrote, or that this one reads."""
        folder = self.scene / name
        removable = {
            owned: state
            for owned, state in self.owned_files().items()
            if self.scene.resolve() / owned not in self.protected
        }
        if os.path.lexists(folder) and not has_only(self.scene, name, removable):
            raise HyrfError(
                f"{folder}: the folder holds files that do not belong to these photos",
                fix=f"choose another folder for the scene, or give {self.scene} as the folder of the photos, too",
            )

    def protect(self, files: Collection[Path]) -> None:
        """Protect the files that the estimation reads from being removed."""
        self.protected = frozenset(path.resolve() for path in files)

    def claim_work_folder(self, settings: list[Any]) -> bool:
        """Create the folder of products in progress, or take over the folder of an interrupted call.

        Args:
            settings: plain values of all settings that affect the products.

        Returns:
            Whether products of an interrupted call with the same files and settings are resumed.
        """
        states = [(str(path), path.stat().st_size, path.stat().st_mtime_ns) for path in sorted(self.protected)]
        fingerprint = hashlib.sha256(json.dumps([_PRODUCTS_VERSION, settings, states]).encode()).hexdigest()
        fingerprint_path = self.work / _FINGERPRINT_NAME
        if fingerprint_path.is_file() and fingerprint_path.read_text() == fingerprint:
            return True
        self.clear()
        self.work.mkdir()
        write_atomic(fingerprint_path, fingerprint.encode())
        return False

    def make_folder(self, name: str, fill: Callable[[Path], object], resume_filling: bool = False) -> Path:
        """Fill one of the scene's folders in progress, unless it is already complete, and return its path.

        Args:
            name: name of the folder.
            fill: called with the folder to fill.
            resume_filling: keep files that an interrupted call has written into the folder.
        """
        folder, unfinished = self.work / name, self.work / f"unfinished-{name}"
        if not folder.is_dir():
            if not resume_filling:
                shutil.rmtree(unfinished, ignore_errors=True)
            unfinished.mkdir(exist_ok=True)
            try:
                fill(unfinished)
            except OSError:  # on a full disk, unfinished copies of many photos would take the space that the user needs
                if not resume_filling:
                    shutil.rmtree(unfinished, ignore_errors=True)
                raise
            os.replace(unfinished, folder)
        return folder

    def owned_files(self) -> OwnedFiles:
        """Return the files that earlier calls wrote into the scene's images/ and masks/ and that are unchanged."""
        return unchanged_files(self.scene, (read_report(self.scene) or {}).get("made"))

    def install(self, model: Path, report: dict[str, Any]) -> None:
        """Move photos, masks and the model to their places in the scene.

        Old poses are removed first, so that they never lie beside new photos. The report lists the owned files before
        they are in place, so that a call after an interruption may replace them.

        Args:
            model: folder of the COLMAP model.
            report: content of the report, without the list of owned files.

        Raises:
            HyrfError: a folder that would be replaced has files of other origin by now.
        """
        report = {**report, "model_files": list_files(model, "sparse/0")}
        old_files = self.owned_files()
        new_files: OwnedFiles = {}
        in_progress = [name for name in OWNED_FOLDERS if (self.work / name).is_dir()]
        for name in in_progress:
            self.check_free(name)  # again, because nothing may be removed unless all of it can be replaced
            new_files |= list_files(self.work / name, name)
        replaced, unfinished = self.work / "replaced", self.work / "sparse"
        for folder in (replaced, unfinished):
            shutil.rmtree(folder, ignore_errors=True)
        if os.path.lexists(self.scene / "sparse"):
            os.replace(self.scene / "sparse", replaced)
        self._write_report(report, old_files | new_files)
        remove_files(self.scene, old_files, self.protected)
        for name in in_progress:
            remove_empty_folder(self.scene / name)
            os.replace(self.work / name, self.scene / name)
        self._write_report(report, self.owned_files())
        unfinished.mkdir()
        os.replace(model, unfinished / "0")
        os.replace(unfinished, self.scene / "sparse")
        self.clear()

    def _write_report(self, report: dict[str, Any], owned: OwnedFiles) -> None:
        """Write the report with the list of owned files."""
        write_atomic(self.scene / REPORT_NAME, json.dumps(report | {"made": owned}, indent=1).encode())

    def clear(self) -> None:
        """Remove the folder of products in progress."""
        shutil.rmtree(self.work, ignore_errors=True)

    def clear_if_empty(self) -> None:
        """Remove the folder of products in progress if it has no products."""
        if all(path.is_dir() or path.name == _FINGERPRINT_NAME for path in self.work.rglob("*")):
            self.clear()


def is_same_path(first: Path, second: Path) -> bool:
    """Return whether two paths lead to the same file or folder."""
    return first.resolve() == second.resolve()


@contextmanager
def explain_disk_errors(out: Path) -> Iterator[None]:
    """Convert errors of the disk and of permissions in the block into a HyrfError."""
    try:
        yield
    except (HyrfError, OSError) as error:
        if is_disk_full(error):
            raise disk_full_error(out) from error
        if isinstance(error, HyrfError):
            raise
        if isinstance(error, FileNotFoundError):
            raise HyrfError(
                f"{error.filename or out}: this file or folder was removed or moved during the estimation",
                fix="put it back and run the same command again",
            ) from error
        raise HyrfError(
            f"{error.filename or out}: this file or folder cannot be read or written ({error.strerror or error})",
            fix="check the folder's permissions and the disk",
        ) from error


def is_disk_full(error: HyrfError | OSError) -> bool:
    """Return whether an error, or its cause, says that the disk or the user's share of it is full.

    The error of `atomic` has such a cause. It asks for the bytes of one small file, which are too few to go on.
    """
    cause = error.__cause__ if isinstance(error, HyrfError) else error
    return isinstance(cause, OSError) and cause.errno in (errno.ENOSPC, errno.EDQUOT)


def disk_full_error(folder: Path) -> HyrfError:
    """Return the error of a full disk, on which a folder lies that keeps the work of an interrupted call."""
    return HyrfError(
        f"{folder}: the disk is full", fix="free some space and run the same command again, which resumes here"
    )

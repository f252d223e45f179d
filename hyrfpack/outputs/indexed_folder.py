"""Folders of files that an index names: all of them are replaced together, and the index is the last."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from hyrfpack.atomic import make_folder, naming_failed_write, pending_file, temporary_folder


class IndexedFolder:
    """A folder whose files are being written, of which the caller writes the index last. Files with other names stay.

    As a context, it keeps new files in a temporary folder and moves them to their places at the end, in the order in
    which they were written. If anything fails, also a move, the folder is as it was. An old index is set aside only
    when all files are written, just before the first is moved, so that it cannot name a mixture of old and new files
    if the process is killed.

    Files refer to each other by name, so a name that is taken causes an error instead of another name.

    Attributes:
        path: the folder.
        bytes: bytes of the files so far.
    """

    def __init__(self, path: Path, index_name: str, overwrite: bool) -> None:
        """Describe the folder.

        Args:
            path: the folder; created if it is missing.
            index_name: name of the index.
            overwrite: replace existing files; if False, an existing file is an error.
        """
        self.path, self.index_name, self.overwrite, self.bytes = path, index_name, overwrite, 0
        self._resources = ExitStack()
        self._names: list[str] = []

    def __enter__(self) -> IndexedFolder:
        make_folder(self.path)
        with naming_failed_write(self.path / self.index_name):
            self._temporary = self._resources.enter_context(temporary_folder(self.path))
        return self

    def __exit__(self, error: type[BaseException] | None, *_: object) -> None:
        with self._resources:
            if error is None:
                self._move_files()

    def write(self, name: str, data: bytes) -> None:
        """Write a file, whose name may contain folders.

        Raises:
            HyrfError: the file cannot be written.
        """
        with self._added(name, len(data)) as path:
            path.write_bytes(data)

    def copy(self, name: str, source: str | os.PathLike[str]) -> None:
        """Copy a file; name and errors are those of `write`."""
        with self._added(name, os.path.getsize(source)) as path:
            shutil.copyfile(source, path)

    @contextmanager
    def _added(self, name: str, length: int) -> Iterator[Path]:
        """Yield the temporary path of a file that the block writes, and count the file."""
        path = self._temporary / name
        with naming_failed_write(self.path / name, length):
            path.parent.mkdir(parents=True, exist_ok=True)
            yield path
            with open(path, "rb+") as file:  # a full disk may be noticed only here, while the old files are there
                os.fsync(file.fileno())
        self._names.append(name)
        self.bytes += path.stat().st_size

    def _move_files(self) -> None:
        """Move all files to their places.

        Raises:
            HyrfError: a file cannot be moved, or it exists and may not be replaced.
        """
        folders = {(self.path / name).parent for name in self._names} - {self.path}
        moved: list[Path] = []
        old_files: list[tuple[str, Path]] = []  # where each old file was, and where it is kept meanwhile
        with naming_failed_write(self.path / self.index_name):
            kept = self._resources.enter_context(temporary_folder(self.path))

        def set_aside(path: Path) -> None:
            if self.overwrite and path.is_file():
                old_files.append((os.path.realpath(path), kept / str(len(old_files))))
                shutil.move(*old_files[-1])

        try:
            with naming_failed_write(self.path / self.index_name):
                set_aside(self.path / self.index_name)
            for name in self._names:
                path, source = self.path / name, self._temporary / name
                length = source.stat().st_size
                with naming_failed_write(path, length):
                    set_aside(path)
                with pending_file(path, length, overwrite=self.overwrite, rename=False) as pending:
                    shutil.move(source, pending.temporary)
                moved.append(path)
        except BaseException:
            for path in moved:
                with suppress(OSError):
                    os.unlink(os.path.realpath(path))
            for original, temporary in reversed(old_files):
                with suppress(OSError):
                    shutil.move(temporary, original)
            for folder in folders:
                with suppress(OSError):  # it holds other files, or was not created
                    folder.rmdir()
            raise

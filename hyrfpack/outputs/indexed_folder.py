"""Folders of files that an index names: the index is written last, so that it never names a missing file."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from hyrfpack.atomic import pending_file, write_atomic


class IndexedFolder:
    """A folder whose files are being written. Files with other names stay.

    Files refer to each other by name, so a name that is taken causes an error instead of another name. As a context, it
    removes the files that did not exist before if anything fails, so that the same call can be repeated.
    """

    def __init__(self, path: Path, overwrite: bool) -> None:
        self.path, self.overwrite, self.bytes = path, overwrite, 0
        self._new: list[Path] = []

    def __enter__(self) -> IndexedFolder:
        return self

    def __exit__(self, error: type[BaseException] | None, *_: object) -> None:
        if error is not None:
            self._remove_new_files()

    def write(self, name: str, data: bytes) -> None:
        """Write a file, whose name may contain folders.

        Raises:
            HyrfError: the file cannot be written, or it exists and may not be replaced.
        """
        with self._recorded(name) as path:
            write_atomic(path, data, overwrite=self.overwrite, rename=False)

    def copy(self, name: str, source: str | os.PathLike[str]) -> None:
        """Copy a file; name and errors are those of `write`."""
        with (
            self._recorded(name) as path,
            pending_file(path, os.path.getsize(source), overwrite=self.overwrite, rename=False) as pending,
        ):
            shutil.copyfile(source, pending.temporary)

    @contextmanager
    def _recorded(self, name: str) -> Iterator[Path]:
        """Yield the path of a file that the block writes, and count the file."""
        path = self.path / name
        is_new = not path.exists()
        yield path
        self._new += [path] * is_new
        self.bytes += path.stat().st_size

    def _remove_new_files(self) -> None:
        """Remove the files that did not exist before, and folders that are empty then."""
        for path in self._new:
            with suppress(OSError):
                path.unlink()
        for folder in {path.parent for path in self._new} - {self.path}:
            with suppress(OSError):  # it holds other files
                folder.rmdir()


@contextmanager
def writing_indexed_folder(path: Path, index_name: str, overwrite: bool) -> Iterator[IndexedFolder]:
    """Yield an `IndexedFolder` to write files into, of which the caller writes the index last.

    An old index is removed first, so that it cannot name a mixture of old and new files.

    Args:
        path: the folder.
        index_name: name of the index.
        overwrite: replace existing files; if False, an existing file is an error.
    """
    if overwrite:
        with suppress(FileNotFoundError):
            (path / index_name).unlink()
    with IndexedFolder(path, overwrite) as folder:
        yield folder

"""Folders of files that an index names: the index is written last, so that it never names a missing file."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

from hyrfpack.atomic import write_atomic


class IndexedFolder:
    """A folder whose files are being written. Files with other names stay."""

    def __init__(self, path: Path, overwrite: bool) -> None:
        self.path, self.overwrite, self.bytes = path, overwrite, 0
        self._new: list[Path] = []

    def write(self, name: str, data: bytes) -> None:
        """Write a file, whose name may contain folders.

        Raises:
            HyrfError: the file cannot be written, or it exists and may not be replaced.
        """
        path = self.path / name
        is_new = not path.exists()
        write_atomic(path, data, overwrite=self.overwrite, rename=False)
        self._new += [path] * is_new
        self.bytes += len(data)

    def remove_new_files(self) -> None:
        """Remove the files that did not exist before, and folders that are empty then."""
        for path in self._new:
            with contextlib.suppress(OSError):
                path.unlink()
        for folder in {path.parent for path in self._new} - {self.path}:
            with contextlib.suppress(OSError):  # it holds other files
                folder.rmdir()


@contextlib.contextmanager
def writing_indexed_folder(path: Path, index_name: str, overwrite: bool) -> Iterator[IndexedFolder]:
    """Yield a folder to write files into, of which the caller writes the index last.

    An old index is removed first, so that it cannot name a mixture of old and new files. If anything fails, the files
    that did not exist before are removed.

    Args:
        path: the folder.
        index_name: name of the index.
        overwrite: replace existing files; if False, an existing file is an error.
    """
    if overwrite:
        with contextlib.suppress(FileNotFoundError):
            (path / index_name).unlink()
    folder = IndexedFolder(path, overwrite)
    try:
        yield folder
    except BaseException:
        folder.remove_new_files()
        raise

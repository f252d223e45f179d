"""Reading of scene folders: a manifest, `scene.json`, with chunk files beside it, or a .zip of them."""

from __future__ import annotations

import logging
import os
import tempfile
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from hyrfpack.errors import HyrfFormatError
from hyrfpack.format.container import Container, read_container
from hyrfpack.format.metadata import read_metadata
from hyrfpack.format.run_folder import name_model
from hyrfpack.format.scene_manifest import (
    FORMAT_NAME,
    MANIFEST_NAME,
    MAX_MANIFEST_BYTES,
    Manifest,
    SceneFile,
    parse_manifest,
)
from hyrfpack.format.sections import SECTION_CONTENTS

if TYPE_CHECKING:
    import torch

    from hyrfpack.model.hybrid import HybridModel
    from hyrfpack.model.merged import MergedModel

_LOG = logging.getLogger(__name__)

StrPath = str | os.PathLike[str]

COPY_AGAIN = "copy the whole folder again, or split the model again"


def is_scene(path: StrPath) -> bool:
    """Return whether a path names a scene folder, its manifest or a .zip of it."""
    path = Path(path)
    if not (path.is_dir() or path.name == MANIFEST_NAME or _is_zip(path)):
        return False
    try:  # Other programs write files of this name, too.
        return FORMAT_NAME.encode() in _SceneFiles.of(path).read(MANIFEST_NAME, MAX_MANIFEST_BYTES)
    except HyrfFormatError:
        return False


@dataclass(frozen=True)
class _SceneFiles:
    """The files of a scene, in a folder or in a .zip.

    Attributes:
        path: the folder or the .zip.
        prefix: the folder within the .zip, "" or "name/"; None for a folder.
    """

    path: Path
    prefix: str | None

    @classmethod
    def of(cls, path: Path) -> _SceneFiles:
        """Return the files of a scene folder, of the folder of a manifest, or of a .zip."""
        if _is_zip(path):
            return cls(path, _find_prefix(path))
        return cls(path.parent if path.name == MANIFEST_NAME and not path.is_dir() else path, None)

    def read(self, name: str, limit: int) -> bytes:
        """Return the bytes of a file, at most `limit` and one more."""
        try:
            if self.prefix is None:
                with open(self.path / name, "rb") as file:
                    return file.read(limit + 1)
            with zipfile.ZipFile(self.path) as archive, archive.open(self.prefix + name) as member:
                return member.read(limit + 1)
        except (OSError, KeyError, zipfile.BadZipFile, zlib.error, RuntimeError, NotImplementedError) as error:
            raise self._unreadable_error(name, error) from error

    def size(self, name: str) -> int:
        """Return the size of a file."""
        try:
            if self.prefix is None:
                return os.stat(self.path / name).st_size
            with zipfile.ZipFile(self.path) as archive:
                return archive.getinfo(self.prefix + name).file_size
        except (OSError, KeyError, zipfile.BadZipFile) as error:
            raise self._unreadable_error(name, error) from error

    def _unreadable_error(self, name: str, error: Exception) -> HyrfFormatError:
        if isinstance(error, (FileNotFoundError, KeyError, NotADirectoryError)):
            return HyrfFormatError(f"{self.path / name}: this file of the scene is missing", fix=COPY_AGAIN)
        reason = getattr(error, "strerror", None) or error
        return HyrfFormatError(f"{self.path / name}: the file cannot be read ({reason})", fix=COPY_AGAIN)


class SceneFolder:
    """A scene folder whose manifest has been checked. Files are checked when they are read.

    Attributes:
        path: the folder, or the .zip file.
        manifest: its manifest.

    Example:
        >>> import hyrfpack
        >>> report = hyrfpack.split_model("bonsai.hyrf", "bonsai-scene", hyrfpack.SplitConfig(levels=1))
        >>> scene = hyrfpack.SceneFolder("bonsai-scene")
        >>> len(scene.load()) == scene.manifest.gaussians == report.gaussians
        True
    """

    def __init__(self, path: StrPath) -> None:
        """Open a scene folder, its manifest, or a .zip of the folder.

        Raises:
            HyrfFormatError: there is no manifest, or it is damaged or of another version.
        """
        self._files = _SceneFiles.of(Path(path))
        self.path = self._files.path
        data = self._files.read(MANIFEST_NAME, MAX_MANIFEST_BYTES)
        self.manifest: Manifest = parse_manifest(data, str(self.path / MANIFEST_NAME))

    def read_file(self, item: SceneFile) -> bytes:
        """Return the bytes of a file, after a check of its size and its checksum.

        Raises:
            HyrfFormatError: the file is missing, damaged, or another one than the manifest says.
        """
        name, data = self.path / item.file, self._files.read(item.file, item.bytes)
        if len(data) != item.bytes:
            raise HyrfFormatError(
                f"{name}: the manifest says {item.bytes:,} bytes and there are {len(data):,}", fix=COPY_AGAIN
            )
        if f"{zlib.crc32(data):08x}" != item.crc32:
            raise HyrfFormatError(f"{name}: its bytes are not those that the manifest lists", fix=COPY_AGAIN)
        return data

    def open_file(self, item: SceneFile) -> Container:
        """Open a file of the folder, after a check of its size and its checksum."""
        return read_container(self.read_file(item), SECTION_CONTENTS, str(self.path / item.file))

    def check_files(self) -> None:
        """Check that all files are there, with the sizes that the manifest lists; none is read.

        A file that looks like a chunk and is not in the manifest is ignored, with a warning.

        Raises:
            HyrfFormatError: a file is missing or has another size.
        """
        for item in self.manifest.files:
            if (size := self._files.size(item.file)) != item.bytes:
                raise HyrfFormatError(
                    f"{self.path / item.file}: the manifest says {item.bytes:,} bytes and there are {size:,}",
                    fix=COPY_AGAIN,
                )
        listed = {item.file for item in self.manifest.files}
        extra = sorted({path.name for path in self.path.glob("*.hyrf")} - listed) if self._files.prefix is None else []
        if extra:
            more = f" and {len(extra) - 1} more" if len(extra) > 1 else ""
            _LOG.warning(f"{self.path / extra[0]}{more}: not in the manifest and ignored")

    def load(
        self, levels: Sequence[int | None] | None = None, device: str | torch.device = "cpu"
    ) -> HybridModel | MergedModel:
        """Return a model of all chunks; a merged model if the scene has several parts.

        Args:
            levels: level of each chunk, 0 for the finest and None to leave it out; None for the finest of all.
            device: device of the parameters, see `hyrfpack.device.choose_device`.

        Raises:
            HyrfFormatError: a file is missing or damaged.
        """
        from hyrfpack.device import choose_device
        from hyrfpack.model.merged import parts_of

        chosen = [0] * len(self.manifest.chunks) if levels is None else levels
        chunks = [None if level is None else self.load_chunk(number, level) for number, level in enumerate(chosen)]
        model = self.join(chunks)
        device = choose_device(device)
        for part in parts_of(model):
            part.to(device)
        return model

    def join(self, chunks: Sequence[HybridModel | None]) -> HybridModel | MergedModel:
        """Return a model of all chunks, given the model of each at any level; a merged model of several parts.

        A chunk without a model is left out.
        """
        from hyrfpack.format.scene_model import join_parts

        names = [part.name for part in self.manifest.parts]
        numbers = [chunk.part for chunk in self.manifest.chunks]
        given = [(chunk, part) for chunk, part in zip(chunks, numbers, strict=True) if chunk is not None]
        return join_parts(names, self.fields, [chunk for chunk, _ in given], [part for _, part in given])

    @cached_property
    def fields(self) -> list[HybridModel]:
        """For each part, a model without Gaussians, of the fields and the exposure map that its chunks share."""
        from hyrfpack.format.decode import decode_container

        models = []
        for part in self.manifest.parts:
            with self.open_file(part) as container:
                models.append(decode_container(container))
            if len(models[-1]):
                raise HyrfFormatError(
                    f"{self.path / part.file}: it holds Gaussians, and should hold only what chunks share",
                    fix=COPY_AGAIN,
                )
        return models

    def read_provenances(self) -> list[dict]:
        """Return the provenance of each part."""
        provenances = []
        for part in self.manifest.parts:
            with self.open_file(part) as container:
                provenances.append(read_metadata(container).provenance)
        return provenances

    def load_chunk(self, number: int, level: int = 0) -> HybridModel:
        """Return the model of one chunk at a level of detail, whose fields are those of its part.

        Raises:
            HyrfFormatError: a file is missing or damaged, or holds another number of Gaussians than the manifest says.
        """
        from hyrfpack.format.decode import decode_container

        chunk = self.manifest.chunks[number]
        item, part = chunk.levels[level], self.manifest.parts[chunk.part]

        def open_shared(name: str) -> Container:
            if name == part.file:
                return self.open_file(part)
            raise HyrfFormatError(
                f"{self.path / item.file}: it refers to {name}, and the manifest says {part.file}", fix=COPY_AGAIN
            )

        with self.open_file(item) as container:
            container.open_file = open_shared
            model = decode_container(container, self.fields[chunk.part])
        if len(model) != item.gaussians:
            raise HyrfFormatError(
                f"{self.path / item.file}: the manifest says {item.gaussians:,} Gaussians and there are {len(model):,}",
                fix=COPY_AGAIN,
            )
        return model


@contextmanager
def single_file(path: StrPath) -> Iterator[Path]:
    """Yield the path of a model's file: `path` itself, or a temporary file of all chunks of a scene, uncompressed.

    The temporary file has the name of the scene, profile "raw" and the scene's finest levels. It is a merged file if
    the scene has several parts.

    Raises:
        HyrfFormatError: a file of the scene is missing or damaged.
    """
    if not is_scene(path):
        yield Path(path)
        return
    from hyrfpack.format.codec import repack

    with tempfile.TemporaryDirectory() as folder:
        joined = Path(folder, f"{name_model(SceneFolder(path).path) or 'scene'}.hyrf")
        repack(path, joined)
        yield joined


def _is_zip(path: Path) -> bool:
    return path.suffix.lower() == ".zip" and path.is_file()


def _find_prefix(path: Path) -> str:
    """Return the folder in a .zip that holds the manifest, "" or "name/"; "" if there is none."""
    try:
        with zipfile.ZipFile(path) as archive:
            names = [name for name in archive.namelist() if name.rpartition("/")[2] == MANIFEST_NAME]
    except (OSError, zipfile.BadZipFile):
        return ""
    return min((name.removesuffix(MANIFEST_NAME) for name in names if name.count("/") <= 1), default="")

"""Reading of scene folders: a manifest, `scene.json`, with chunk files beside it, or a .zip of them."""

from __future__ import annotations

import logging
import os
import tempfile
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from copy import deepcopy
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hyrfpack.errors import HyrfFormatError, short_reason
from hyrfpack.format.container import Container, open_regular_file, raw_bytes_limit, read_container
from hyrfpack.format.metadata import read_metadata
from hyrfpack.format.run_folder import is_run_folder, is_scene_manifest, name_model
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

COPY_AGAIN_FIX = "copy the whole folder again, or split the model again"


def is_scene(path: StrPath) -> bool:
    """Return whether a path names a scene folder, its manifest or a .zip of it.

    The folder of a run is none, even if it has a manifest, too: as for `find_model`, the run counts.
    """
    path = Path(path)
    if not _is_zip(path):
        return is_scene_manifest(_find_manifest(path)) and not is_run_folder(path)
    try:
        with closing(_SceneFiles(path)) as files:
            return FORMAT_NAME.encode() in files.read(MANIFEST_NAME, MAX_MANIFEST_BYTES)
    except HyrfFormatError:
        return False


def refuse_fraction(path: StrPath, fraction: float | None) -> None:
    """Raise HyrfFormatError if a fraction of a scene folder is asked for."""
    if fraction is not None:
        raise HyrfFormatError(
            f"{path}: a scene folder has levels in place of layers, so that no fraction of it can be read",
            fix="leave out `fraction`",
        )


class _SceneFiles:
    """The files of a scene, in a folder or in a .zip; several threads may read them.

    Attributes:
        path: the folder or the .zip.
        is_folder: whether the files lie in a folder.
    """

    def __init__(self, path: Path) -> None:
        """Find the files of a scene folder, of the folder of a manifest, or of a .zip."""
        self.is_folder = not _is_zip(path)
        self._prefix = ""  # the folder within the .zip, "" or "name/"
        self._opened: tuple[int, zipfile.ZipFile] | None = None  # the archive and the process that opened it
        if self.is_folder:
            self.path = _find_manifest(path).parent
        else:
            self.path = path
            with _add_path_to_errors(path):
                self._prefix = _find_prefix(self._archive())

    def _archive(self) -> zipfile.ZipFile:
        """Return the .zip, which stays open. Forked processes open it anew, because they would share its position."""
        if self._opened is None or self._opened[0] != os.getpid():
            self._opened = os.getpid(), zipfile.ZipFile(self.path)
        return self._opened[1]

    def close(self) -> None:
        """Close the .zip, if it is open; a later read opens it again."""
        opened, self._opened = self._opened, None
        if opened is not None:
            opened[1].close()

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_opened": None}

    def read(self, name: str, limit: int) -> bytes:
        """Return the bytes of a file, at most `limit` and one more; nothing is read of a file that unpacks to more."""
        with _add_path_to_errors(self.path / name):
            if self.is_folder:
                with open_regular_file(self.path / name) as file:
                    return file.read(limit + 1)
            info = self._archive().getinfo(self._prefix + name)
            # An archive may declare any size, and some of its codecs shrink zeros without limit.
            allowed = raw_bytes_limit(info.compress_size)
            if info.file_size > allowed:
                raise HyrfFormatError(
                    f"{self.path / name}: its {info.compress_size:,} bytes would unpack to {info.file_size:,}, more "
                    f"than {allowed:,}",
                    fix=COPY_AGAIN_FIX,
                )
            with self._archive().open(info) as member:
                return member.read(limit + 1)

    def measure_size(self, name: str) -> int:
        """Return the size of a file in bytes, unpacked; the file is not read."""
        with _add_path_to_errors(self.path / name):
            if self.is_folder:
                return os.stat(self.path / name).st_size
            return self._archive().getinfo(self._prefix + name).file_size


@contextmanager
def _add_path_to_errors(path: Path) -> Iterator[None]:
    """Turn whatever is raised where a file is opened, read or unpacked into a HyrfFormatError that names the file."""
    try:
        yield
    except (HyrfFormatError, MemoryError):
        raise
    except (FileNotFoundError, KeyError, NotADirectoryError) as error:
        raise HyrfFormatError(f"{path}: this file of the scene is missing", fix=COPY_AGAIN_FIX) from error
    except Exception as error:  # zipfile and its decompressors raise exceptions of many types
        reason = getattr(error, "strerror", None) or short_reason(error)
        raise HyrfFormatError(f"{path}: the file cannot be read ({reason})", fix=COPY_AGAIN_FIX) from error


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
        self._files = _SceneFiles(Path(path))
        self.path = self._files.path
        data = self._files.read(MANIFEST_NAME, MAX_MANIFEST_BYTES)
        self.manifest: Manifest = parse_manifest(data, str(self.path / MANIFEST_NAME))

    def __getstate__(self) -> dict[str, Any]:
        """Return what is pickled: shared files are opened again when they are needed."""
        return {name: value for name, value in self.__dict__.items() if name != "_shared_files"}

    def close(self) -> None:
        """Close a .zip, which is kept open between reads; a later read opens it again."""
        self._files.close()

    def read_file(self, item: SceneFile) -> bytes:
        """Return the bytes of a file, after a check of its size and its checksum.

        Raises:
            HyrfFormatError: the file is missing, damaged, or another one than the manifest says.
        """
        self._check_size(item, self._files.measure_size(item.file))
        name, data = self.path / item.file, self._files.read(item.file, item.bytes)
        self._check_size(item, len(data))
        if f"{zlib.crc32(data):08x}" != item.crc32:
            raise HyrfFormatError(f"{name}: its bytes are not those that the manifest lists", fix=COPY_AGAIN_FIX)
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
            self._check_size(item, self._files.measure_size(item.file))
        listed = {item.file for item in self.manifest.files}
        unlisted = sorted({path.name for path in self.path.glob("*.hyrf")} - listed) if self._files.is_folder else []
        if unlisted:
            more = f" and {len(unlisted) - 1} more" if len(unlisted) > 1 else ""
            _LOG.warning(f"{self.path / unlisted[0]}{more}: not in the manifest and ignored")

    def _check_size(self, item: SceneFile, size: int) -> None:
        if size != item.bytes:
            raise HyrfFormatError(
                f"{self.path / item.file}: the manifest says {item.bytes:,} bytes and there are {size:,}",
                fix=COPY_AGAIN_FIX,
            )

    def load(
        self, levels: Sequence[int | None] | None = None, device: str | torch.device = "cpu"
    ) -> HybridModel | MergedModel:
        """Return a model of all chunks, with fields of its own; a merged model if the scene has several parts.

        Args:
            levels: level of each chunk, 0 for the finest and None to leave it out; None for the finest of all.
            device: device of the parameters, see `hyrfpack.device.choose_device`.

        Raises:
            HyrfFormatError: a file is missing or damaged.
        """
        from hyrfpack.device import choose_device
        from hyrfpack.model.merged import parts_of

        device = choose_device(device)
        levels = [0] * len(self.manifest.chunks) if levels is None else levels
        chunks = [None if level is None else self.load_chunk(number, level) for number, level in enumerate(levels)]
        model = self.join(chunks)
        for part in parts_of(model):
            # The next call needs the fields as they are, wherever this model moves.
            part.geometry, part.radiance = deepcopy(part.geometry), deepcopy(part.radiance)
            part.to(device)
        return model

    def join(self, chunks: Sequence[HybridModel | None]) -> HybridModel | MergedModel:
        """Return a model of all chunks, given the model of each at any level; a merged model of several parts.

        A chunk without a model is left out. The model shares `fields`.
        """
        from hyrfpack.format.scene_model import join_parts

        names = [part.name for part in self.manifest.parts]
        numbers = [chunk.part for chunk in self.manifest.chunks]
        present = [(chunk, part) for chunk, part in zip(chunks, numbers, strict=True) if chunk is not None]
        return join_parts(names, self.fields, [chunk for chunk, _ in present], [part for _, part in present])

    @cached_property
    def _shared_files(self) -> list[Container]:
        """The shared file of each part, in memory; all chunks of the part refer to it."""
        return [self.open_file(part) for part in self.manifest.parts]

    @cached_property
    def fields(self) -> list[HybridModel]:
        """For each part, a model without Gaussians, of the fields and the exposure map that its chunks share."""
        from hyrfpack.format.decode import decode_container

        models = []
        for part, container in zip(self.manifest.parts, self._shared_files, strict=True):
            models.append(decode_container(container))
            if len(models[-1]):
                raise HyrfFormatError(
                    f"{self.path / part.file}: it holds Gaussians, and should hold only what chunks share",
                    fix=COPY_AGAIN_FIX,
                )
        return models

    def read_provenances(self) -> list[dict]:
        """Return the provenance of each part."""
        return [deepcopy(read_metadata(container).provenance) for container in self._shared_files]

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
                return self._shared_files[chunk.part]
            raise HyrfFormatError(
                f"{self.path / item.file}: it refers to {name}, and the manifest says {part.file}", fix=COPY_AGAIN_FIX
            )

        with self.open_file(item) as container:
            container.open_file = open_shared
            model = decode_container(container, self.fields[chunk.part])
        if len(model) != item.gaussians:
            raise HyrfFormatError(
                f"{self.path / item.file}: the manifest says {item.gaussians:,} Gaussians and there are {len(model):,}",
                fix=COPY_AGAIN_FIX,
            )
        return model


@contextmanager
def as_single_file(path: StrPath) -> Iterator[Path]:
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


def _find_manifest(path: Path) -> Path:
    """Return the path of the manifest that a path names, or of the one in the folder that it names."""
    return path if path.name == MANIFEST_NAME and not os.path.isdir(path) else path / MANIFEST_NAME


def _is_zip(path: Path) -> bool:
    return path.suffix.lower() == ".zip" and os.path.isfile(path)


def _find_prefix(archive: zipfile.ZipFile) -> str:
    """Return the folder in a .zip that holds the manifest, "" or "name/"; "" if there is none."""
    names = [name for name in archive.namelist() if name.rpartition("/")[2] == MANIFEST_NAME]
    return min((name.removesuffix(MANIFEST_NAME) for name in names if name.count("/") <= 1), default="")

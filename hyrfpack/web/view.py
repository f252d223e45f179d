"""Viewing of a scene in a browser of this machine."""

from __future__ import annotations

import io
import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import BinaryIO

from hyrfpack.errors import HyrfDataError, suggest_command
from hyrfpack.format import describe_file, find_model
from hyrfpack.format.run_folder import name_model
from hyrfpack.format.scene_folder import SceneFolder, is_scene
from hyrfpack.format.scene_manifest import MANIFEST_NAME, SceneFile
from hyrfpack.ply import MAX_HEADER_BYTES
from hyrfpack.splats.formats.ply_header import check_gaussians
from hyrfpack.splats.names import SPLATS_SUFFIXES, find_sog_folder, is_splats
from hyrfpack.web.player import MODEL_SUFFIX, encode_player
from hyrfpack.web.serve import LOCAL_HOST, MemoryFile, OpenableFile, ServedFiles, serve

FOLDER_ADDRESS = "scene/"  # of the files of a scene folder


def view(
    path: str | os.PathLike[str],
    *,
    host: str = LOCAL_HOST,
    port: int = 0,
    open_browser: bool,
    on_ready: Callable[[str], None],
) -> None:
    """Serve a scene and a player for it until interrupted; the page decodes a file, or streams a scene folder.

    Args:
        path: a `.hyrf` file, the folder of a run, a scene folder, its manifest or a .zip of it, or a file of splats
            with one of the suffixes `hyrfpack.splats.names.SPLATS_SUFFIXES`.
        host, port, open_browser, on_ready: as for `hyrfpack.web.serve.serve`.

    Raises:
        HyrfError: there is no such file, its first kilobytes are damaged, a PLY holds no Gaussians, or the server
            cannot listen at the address.
    """
    page, files = _scene_page(path) if is_scene(path) else _file_page(path)
    serve(page, files, host=host, port=port, open_browser=open_browser, on_ready=on_ready)


MAX_UNPACKED_FILES = 2  # Browsers may request a file piece by piece.


@dataclass(frozen=True)
class _ArchivedFile:
    """A file of a scene in a .zip, which is read when it is requested, so that large scenes are not held in memory.

    Attributes:
        read: returns the bytes of a file of the scene, after a check of its checksum.
        item: the file.
    """

    read: Callable[[SceneFile], bytes]
    item: SceneFile

    def open(self) -> tuple[BinaryIO, int, str]:
        """Return the file for reading, its length in bytes and its ETag."""
        data = self.read(self.item)
        return io.BytesIO(data), len(data), f'"{self.item.crc32}-{len(data):x}"'


def _scene_page(path: str | os.PathLike[str]) -> tuple[bytes, ServedFiles]:
    """Return a page that streams a scene folder, and the files of that folder."""
    scene = SceneFolder(path)
    scene.check_files()
    files: dict[str, Path | OpenableFile] = {FOLDER_ADDRESS + MANIFEST_NAME: MemoryFile(scene.manifest.to_json())}
    is_folder, read = scene.path.is_dir(), lru_cache(MAX_UNPACKED_FILES)(scene.read_file)
    for item in scene.manifest.files:
        files[FOLDER_ADDRESS + item.file] = scene.path / item.file if is_folder else _ArchivedFile(read, item)
    title = scene.manifest.title or name_model(scene.path) or "scene"
    return encode_player(title, content=FOLDER_ADDRESS + MANIFEST_NAME, fetches="'self'"), files


def _file_page(path: str | os.PathLike[str]) -> tuple[bytes, ServedFiles]:
    """Return a page that plays a file, and that file. Commands that the page shows name its path."""
    file = find_playable_file(path)
    suffix = file.suffix.lower()
    if suffix in SPLATS_SUFFIXES:
        _check_splats(file)
    else:
        suffix = MODEL_SUFFIX
        describe_file(file)
    name = f"scene{suffix}"
    title = name_model(path)
    return encode_player(title, content=name, fetches="'self'", editable=True, file=str(file)), {name: file}


def find_playable_file(path: str | os.PathLike[str]) -> Path:
    """Return the file that a page plays: splats, or a model that is named by its path or by the folder of its run.

    Raises:
        HyrfDataError: the splats are a SOG folder, which has to be bundled into one file first.
        HyrfFormatError: the path is a folder without a model.
    """
    if not is_splats(path):
        return find_model(path)
    if find_sog_folder(path) is not None:
        raise HyrfDataError(
            f"{path}: a page plays single files",
            fix=f"bundle these with {suggest_command('convert', path, 'scene.sog')}",
        )
    return Path(path)


def _check_splats(path: Path) -> None:
    """Check that a file of splats can be read, is not empty, and, if it is a PLY, holds Gaussians.

    Raises:
        HyrfDataError: one of the checks fails.
    """
    try:
        with path.open("rb") as file:
            start = file.read(MAX_HEADER_BYTES)
    except OSError as error:
        raise HyrfDataError(
            f"{path}: the file cannot be read ({error.strerror or error})",
            fix="check the path",
        ) from error
    if not start:
        raise HyrfDataError(f"{path}: the file is empty", fix="write it again")
    if path.suffix.lower() == ".ply":
        check_gaussians(start, str(path))

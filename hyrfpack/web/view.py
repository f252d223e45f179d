"""Viewing of a scene's file in a browser of this machine."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from hyrfpack.errors import HyrfDataError
from hyrfpack.format import describe_file, find_model
from hyrfpack.format.scene_folder import single_file
from hyrfpack.splats.names import SPLATS_SUFFIXES, is_splats, sog_folder
from hyrfpack.web.player import MODEL_SUFFIX, encode_player
from hyrfpack.web.serve import LOCAL_HOST, serve


def view(
    path: str | os.PathLike[str],
    *,
    host: str = LOCAL_HOST,
    port: int = 0,
    open_browser: bool,
    on_ready: Callable[[str], None],
) -> None:
    """Serve a scene's file and a player for it until interrupted; the page decodes the file.

    Args:
        path: a `.hyrf` file, the folder of a run, a scene folder, or a file of splats with one of the suffixes
            `hyrfpack.splats.names.SPLATS_SUFFIXES`.
        host, port, open_browser, on_ready: as for `hyrfpack.web.serve.serve`.

    Raises:
        HyrfError: there is no such file, its first kilobytes are damaged, or the server cannot listen at the address.
    """
    with single_file(path) as file:
        _serve_file(file, str(find_playable_file(path)), host, port, open_browser, on_ready)


def _serve_file(
    path: Path, shown_path: str, host: str, port: int, open_browser: bool, on_ready: Callable[[str], None]
) -> None:
    """Serve a file; commands that the page shows name `shown_path`."""
    title, path = path.stem, find_playable_file(path)
    suffix = path.suffix.lower()
    if suffix in SPLATS_SUFFIXES:
        _check_readable(path)
    else:
        suffix = MODEL_SUFFIX
        describe_file(path)
    name = f"scene{suffix}"
    page = encode_player(title, content=name, fetches="'self'", editable=True, file=shown_path)
    serve(page, {name: path}, host=host, port=port, open_browser=open_browser, on_ready=on_ready)


def find_playable_file(path: str | os.PathLike[str]) -> Path:
    """Return the file that a page plays: splats, or a model that is named by its path or by the folder of its run.

    Raises:
        HyrfDataError: the splats are a SOG folder, which has to be bundled into one file first.
        HyrfFormatError: the path is a folder without a model.
    """
    if not is_splats(path):
        return find_model(path)
    if sog_folder(path) is not None:
        raise HyrfDataError(
            f"{path}: a page plays single files",
            fix=f"bundle these with 'hyrfpack convert {path} scene.sog'",
        )
    return Path(path)


def _check_readable(path: str | os.PathLike[str]) -> None:
    """Raise HyrfDataError unless the file can be read and is not empty."""
    try:
        with open(path, "rb") as file:
            if not file.read(1):
                raise HyrfDataError(f"{path}: the file is empty", fix="write it again")
    except OSError as error:
        raise HyrfDataError(
            f"{path}: the file cannot be read ({error.strerror or error})",
            fix="check the path",
        ) from error

"""A file of a scene, looked at in a browser of this machine."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from hyrfpack.errors import HyrfDataError
from hyrfpack.format import describe, find_model
from hyrfpack.splats.names import is_splats, sog_folder
from hyrfpack.web.player import MODEL, SPLATS, encode_player
from hyrfpack.web.serve import LOCAL, serve


def view(
    path: str | os.PathLike[str],
    *,
    host: str = LOCAL,
    port: int = 0,
    open_browser: bool,
    say: Callable[[str], None],
) -> None:
    """Serve a scene's file and a player for it until interrupted. Nothing is decoded here: the page does that.

    Args:
        path: a `.hyrf` file or the folder of a run, or a file of splats with an ending of `hyrfpack.web.player.SPLATS`.
        host, port, open_browser, say: as of `hyrfpack.web.serve.serve`.

    Raises:
        HyrfError: there is no such file, or its first kilobytes are damaged, or nothing can listen there.
    """
    title, path = Path(path).stem, playable_file(path)
    ending = path.suffix.lower()
    if ending in SPLATS:
        _check_there(path)
    else:
        ending = MODEL
        describe(path)
    name = f"scene{ending}"
    page = encode_player(title, content=name, fetches="'self'")
    serve(page, {name: path}, host=host, port=port, open_browser=open_browser, say=say)


def playable_file(path: str | os.PathLike[str]) -> Path:
    """Return the one file that a page plays: splats, or a model, named by its path or by the folder of its run.

    Raises:
        HyrfDataError: it is a SOG that is not bundled.
        HyrfFormatError: it is a folder without a model.
    """
    if not is_splats(path):
        return find_model(path)
    if sog_folder(path) is not None:
        raise HyrfDataError(f"{path}: a page plays single files; bundle these with 'hyrfpack convert {path} scene.sog'")
    return Path(path)


def _check_there(path: str | os.PathLike[str]) -> None:
    try:
        with open(path, "rb") as file:
            if not file.read(1):
                raise HyrfDataError(f"{path}: the file is empty; write it again")
    except OSError as error:
        raise HyrfDataError(f"{path}: the file cannot be read ({error.strerror or error}); check the path") from error

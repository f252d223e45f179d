"""Serve a scene folder with a player that streams it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import hyrfpack
from hyrfpack.format.scene_manifest import MANIFEST_NAME
from hyrfpack.web.player import encode_player
from hyrfpack.web.serve import serve_in_thread


@contextmanager
def serve_scene(folder: Path, budget: int) -> Iterator[str]:
    """Serve a scene folder; yield the address of a page that draws at most `budget` Gaussians of it."""
    names = [MANIFEST_NAME, *(item.file for item in hyrfpack.SceneFolder(folder).manifest.files)]
    page = encode_player(folder.name, content=f"scene/{MANIFEST_NAME}", fetches="'self'")
    with serve_in_thread(page, {f"scene/{name}": folder / name for name in names}) as address:
        yield f"{address}?gaussians={budget}"

"""Finds the folder of a scene, all of whose files are read, so that no output may be written into it."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

from hyrfpack.format.scene_folder import SceneFolder, StrPath, is_scene


def find_input_folder(source: StrPath) -> Path | None:
    """Return the folder, or the .zip, of the scene that `source` names; None if a single file is read.

    Raises:
        HyrfFormatError: the manifest of the scene is damaged.
    """
    if not is_scene(source):
        return None
    with closing(SceneFolder(source)) as scene:
        return scene.path

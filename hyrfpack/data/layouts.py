"""The table of layouts, with the functions that recognise and read each. The first match is used."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from hyrfpack.data.blender import read_blender
from hyrfpack.data.bundler import find_bundle, read_bundler
from hyrfpack.data.colmap import read_colmap
from hyrfpack.data.llff import POSES_FILE, read_llff
from hyrfpack.data.metashape import find_metashape, read_metashape
from hyrfpack.data.nerfstudio import read_nerfstudio
from hyrfpack.data.polycam import has_polycam_cameras, read_polycam
from hyrfpack.data.realityscan import find_realityscan, read_realityscan
from hyrfpack.data.record3d import find_record3d, read_record3d
from hyrfpack.data.search import find_models
from hyrfpack.scene import Scene


@dataclass(frozen=True)
class Layout:
    """One arrangement of photos and poses in a folder.

    Attributes:
        files: the files that identify the layout, in words for messages.
        find: returns a truthy value if a folder has this layout.
        read: `read(folder, *, test_every, max_size, **options)`, which reads the scene.
        options: further arguments of `load_scene` that `read` takes: "images", "model".
    """

    files: str
    find: Callable[[Path], object]
    read: Callable[..., Scene]
    options: tuple[str, ...] = ()

    def is_present(self, folder: Path) -> bool:
        """Return whether a folder has this layout."""
        return bool(self.find(folder))


def _has_file(name: str) -> Callable[[Path], bool]:
    """Return a function that checks whether a folder holds a file of this name."""
    return lambda folder: os.path.isfile(folder / name)


LAYOUTS = {
    "colmap": Layout("a COLMAP model in sparse/0", find_models, read_colmap, ("images", "model")),
    "blender": Layout("transforms_train.json", _has_file("transforms_train.json"), read_blender),
    "nerfstudio": Layout("transforms.json", _has_file("transforms.json"), read_nerfstudio, ("images",)),
    "llff": Layout(POSES_FILE, _has_file(POSES_FILE), read_llff, ("images",)),
    "metashape": Layout("cameras of Metashape as .xml", find_metashape, read_metashape, ("images",)),
    "bundler": Layout("a bundle file as .out", find_bundle, read_bundler),
    "realityscan": Layout("camera parameters of RealityScan as .csv", find_realityscan, read_realityscan, ("images",)),
    "polycam": Layout("keyframes/ of Polycam", has_polycam_cameras, read_polycam),
    "record3d": Layout("metadata of Record3D", find_record3d, read_record3d),
}

"""The table of layouts: how each is recognised, and what reads it. The first that is there is taken."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from hyrfpack.data.blender import read_blender
from hyrfpack.data.bundler import find_bundle, read_bundler
from hyrfpack.data.colmap import read_colmap
from hyrfpack.data.llff import TABLE, read_llff
from hyrfpack.data.metashape import find_metashape, read_metashape
from hyrfpack.data.nerfstudio import read_nerfstudio
from hyrfpack.data.places import find_models
from hyrfpack.data.polycam import holds_polycam, read_polycam
from hyrfpack.data.realityscan import find_realityscan, read_realityscan
from hyrfpack.data.record3d import find_record3d, read_record3d
from hyrfpack.scene import Scene


@dataclass(frozen=True)
class Layout:
    """One way in which photos and poses lie in a folder.

    Attributes:
        mark: what makes a folder one of this layout, in words.
        find: something that is true if a folder is.
        read: `read(folder, *, test_every, max_size, **options)`, which makes the scene.
        options: further arguments of `load_scene` that `read` takes: "images", "model".
    """

    mark: str
    find: Callable[[Path], object]
    read: Callable[..., Scene]
    options: tuple[str, ...] = ()

    def is_there(self, folder: Path) -> bool:
        """Whether a folder has this layout."""
        return bool(self.find(folder))


def _file(name: str) -> Callable[[Path], bool]:
    return lambda folder: os.path.isfile(folder / name)


LAYOUTS = {
    "colmap": Layout("a COLMAP model in sparse/0", find_models, read_colmap, ("images", "model")),
    "blender": Layout("transforms_train.json", _file("transforms_train.json"), read_blender),
    "nerfstudio": Layout("transforms.json", _file("transforms.json"), read_nerfstudio, ("images",)),
    "llff": Layout(TABLE, _file(TABLE), read_llff, ("images",)),
    "metashape": Layout("cameras of Metashape as .xml", find_metashape, read_metashape, ("images",)),
    "bundler": Layout("a bundle file as .out", find_bundle, read_bundler),
    "realityscan": Layout("camera parameters of RealityScan as .csv", find_realityscan, read_realityscan, ("images",)),
    "polycam": Layout("keyframes/ of Polycam", holds_polycam, read_polycam),
    "record3d": Layout("metadata of Record3D", find_record3d, read_record3d),
}

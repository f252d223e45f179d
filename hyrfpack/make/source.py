"""What is given to be made a scene of: photos with poses or without, a video, splats of other programs, or a model."""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from hyrfpack.data import load_scene
from hyrfpack.data.archive import is_archive, unpack
from hyrfpack.data.folder import list_photos
from hyrfpack.errors import HyrfDataError, HyrfNoPosesError
from hyrfpack.make.held_out import inner_view
from hyrfpack.outputs import PICTURE_SUFFIXES, VIDEO_SUFFIXES, Outputs, StrPath
from hyrfpack.scene import DEFAULT_MAX_SIZE, Scene
from hyrfpack.splats.files import READABLE_ENDINGS

FEW, LEAST = 16, 8  # photos, of which one is held out, or none
TEST_EVERY = 8  # of more, one in so many is
_LOOSE_SOG = "meta.json"


@dataclass(frozen=True)
class Reading:
    """How photos are read: the arguments of `load_scene`.

    Without `test_every`, one in TEST_EVERY of many photos is held out, of fewer than FEW the one that is best
    surrounded by others (`inner_view`), and of fewer than LEAST none. A split of the set's own counts instead.
    """

    images: str | None = None
    max_size: int = DEFAULT_MAX_SIZE
    test_every: int | None = None

    def scene(self, path: Path, max_size: int | None = None) -> Scene:
        """Read photos with poses, at another size than this if that is given."""
        size = self.max_size if max_size is None else max_size
        read = partial(load_scene, path, images=self.images, max_size=size)
        scene = read(test_every=TEST_EVERY if self.test_every is None else self.test_every)
        if self.test_every is not None or len(scene.views) >= FEW:
            return scene
        scene = read(test_every=0)
        if scene.test or len(scene.views) < LEAST:
            return scene
        return read(held_out=[inner_view(scene).name])


@dataclass(frozen=True)
class Source:
    """What is given.

    Attributes:
        path: the file or folder; of photos without poses, the folder that they are in.
        kind: "photos" that have no poses, a "video", a "scene" of photos with poses, "splats" or a "model".
        scene: the photos with poses, as they are read.
        archive: that photos without poses came in; `path` is where they are unpacked.
    """

    path: Path
    kind: str
    scene: Scene | None = None
    archive: Path | None = None

    @classmethod
    def of(cls, path: StrPath, reading: Reading) -> Source:
        """Look at what is given.

        Raises:
            HyrfDataError: it is nothing that a scene can be made of.
        """
        path = Path(path)
        if not os.path.lexists(path):
            raise HyrfDataError(f"{path}: no such file or folder; check the path")
        ending = path.suffix.lower()
        if path.is_file() and (ending == ".hyrf" or ending in READABLE_ENDINGS or path.name == _LOOSE_SOG):
            return cls(path, "model" if ending == ".hyrf" else "splats")
        if path.is_file() and not (is_archive(path) or ending in VIDEO_SUFFIXES):
            one = "this is one photo" if ending in PICTURE_SUFFIXES else "nothing can be made of this file"
            raise HyrfDataError(
                f"{path}: {one}; name a folder of photos, its .zip, a video, a .hyrf file, or splats of another program"
            )
        try:
            return cls(path, "scene", reading.scene(path))
        except HyrfNoPosesError:
            if ending in VIDEO_SUFFIXES and path.is_file():
                return cls(path, "video")
            if (path / _LOOSE_SOG).is_file():
                return cls(path, "splats")
            archive, folder = (path, unpack(path)) if is_archive(path) else (None, path)
            return cls(folder / (reading.images or ""), "photos", archive=archive)
        except HyrfDataError:
            videos = (
                sorted(p.name for p in path.iterdir() if p.suffix.lower() in VIDEO_SUFFIXES) if path.is_dir() else []
            )
            if videos and not list_photos(path):
                message = f"{path}: there are no photos in this folder, but {videos[0]}; name the video"
                raise HyrfDataError(message) from None
            if path.is_dir() and not any(path.iterdir()):
                raise HyrfDataError(f"{path}: the folder is empty; name the one that holds the photos") from None
            raise

    def files(self) -> list[Path]:
        """What poses are estimated from: photos and their masks, or a video."""
        if self.path.is_file():
            return [self.path]
        masks = [self.path / "masks", self.path / "mask"]
        masks += [self.path.parent / "masks"] if self.path.name == "images" else []
        return [*list_photos(self.path), *(p for folder in masks for p in sorted(folder.rglob("*")) if p.is_file())]

    def outputs(self, overwrite: bool) -> list[Outputs]:
        """The rules of what may be written beside what is read, all of which hold."""
        if self.kind == "photos":
            folders = sorted({photo.parent for photo in list_photos(self.path)} | {self.path})
            return [Outputs(folder=folder, overwrite=overwrite) for folder in folders]
        folder = self.path.parent if self.path.name == _LOOSE_SOG else self.path
        return [Outputs(self.path, folder=folder, scene=self.scene, overwrite=overwrite)]

"""Inspect the source of a scene: photos with or without poses, a video, splats of another program, or a model."""

from __future__ import annotations

import os
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from hyrfpack.data import load_scene
from hyrfpack.data.archive import is_archive, unpack
from hyrfpack.data.equirectangular import group_faces
from hyrfpack.data.folder import explain_missing_path, list_photos, list_pictures
from hyrfpack.data.masks import locate_masks
from hyrfpack.errors import HyrfDataError, HyrfNoPosesError
from hyrfpack.make.held_out import choose_inner_view
from hyrfpack.outputs import PICTURE_SUFFIXES, VIDEO_SUFFIXES, Outputs, StrPath
from hyrfpack.scene import DEFAULT_MAX_SIZE, DEFAULT_TEST_EVERY, Scene
from hyrfpack.splats.names import SOG_META_NAME, is_sog_folder, is_splats

MIN_SPLIT_PHOTOS = 16  # if there are fewer photos, a single one is held out
MIN_HELD_OUT_PHOTOS = 8  # if there are fewer photos, none is held out


@dataclass(frozen=True)
class LoadSettings:
    """Settings with which photos are read, see `load_scene`.

    Without `test_every`, every 8th photo is held out (DEFAULT_TEST_EVERY). If there are fewer than MIN_SPLIT_PHOTOS,
    only the photo that is best surrounded by others is held out (`choose_inner_view`). If there are fewer than
    MIN_HELD_OUT_PHOTOS, none is held out. If the set has a split of its own, that is used instead. A panorama is one
    photo, whose faces are held out together.
    """

    images: str | None = None
    max_size: int = DEFAULT_MAX_SIZE
    test_every: int | None = None

    def load(self, path: Path, max_size: int | None = None) -> Scene:
        """Read photos with poses; `max_size` overrides that of these settings."""
        size = self.max_size if max_size is None else max_size
        read = partial(load_scene, path, images=self.images, max_size=size)
        if self.test_every is not None:
            return read(test_every=self.test_every)
        with suppress(HyrfDataError):  # of a single photo, none is left to train on
            scene = read(test_every=DEFAULT_TEST_EVERY)
            if len(group_faces(scene.views)) >= MIN_SPLIT_PHOTOS:
                return scene
        scene = read(test_every=0)
        photos = group_faces(scene.views)
        if scene.test or len(photos) < MIN_HELD_OUT_PHOTOS:
            return scene
        inner = choose_inner_view(scene)
        return read(held_out=[view.name for photo in photos if inner in photo for view in photo])


@dataclass(frozen=True)
class Source:
    """The source of a scene.

    Attributes:
        path: the file or folder; for photos without poses, the folder that contains them.
        kind: "photos" (without poses), "video", "scene" (photos with poses), "splats" or "model".
        scene: the photos with poses; None for other kinds.
        archive: the archive from which photos without poses were unpacked to `path`; None if there was none.
    """

    path: Path
    kind: str
    scene: Scene | None = None
    archive: Path | None = None

    @classmethod
    def from_path(cls, path: StrPath, load_settings: LoadSettings) -> Source:
        """Determine the kind of source at a path, and load photos that have poses.

        Raises:
            HyrfDataError: no scene can be made from this path.
        """
        path = Path(path)
        if (reason := explain_missing_path(path, "file or folder")) is not None:
            raise HyrfDataError(f"{path}: {reason}", fix="check the path")
        ending = path.suffix.lower()
        if path.is_file() and (ending == ".hyrf" or is_splats(path)):
            return cls(path, "model" if ending == ".hyrf" else "splats")
        if path.is_file() and not (is_archive(path) or ending in VIDEO_SUFFIXES):
            what = "this is one photo" if ending in PICTURE_SUFFIXES else "no scene can be made from this kind of file"
            raise HyrfDataError(
                f"{path}: {what}",
                fix="name a folder of photos, its .zip, a video, a .hyrf file, or splats of another program",
            )
        try:
            return cls(path, "scene", load_settings.load(path))
        except HyrfNoPosesError:
            if ending in VIDEO_SUFFIXES and path.is_file():
                return cls(path, "video")
            if is_sog_folder(path):
                return cls(path, "splats")
            archive, folder = (path, unpack(path)) if is_archive(path) else (None, path)
            return cls(folder / (load_settings.images or ""), "photos", archive=archive)
        except HyrfDataError:
            names = _list_names(path)
            videos = [name for name in names or () if Path(name).suffix.lower() in VIDEO_SUFFIXES]
            if videos and not list_photos(path):
                problem = f"{path}: there are no photos in this folder, but the video {videos[0]}"
                raise HyrfDataError(problem, fix="name the video itself") from None
            if names == []:
                raise HyrfDataError(
                    f"{path}: the folder is empty", fix="name the folder that holds the photos"
                ) from None
            raise

    def files(self) -> list[Path]:
        """Return the files from which poses are estimated: photos and their masks, or a video."""
        if self.path.is_file():
            return [self.path]
        masks = locate_masks(self.path)
        return [*list_photos(self.path), *([] if masks is None else list_pictures(masks))]

    def output_rules(self, overwrite: bool) -> Outputs:
        """Return the rules that protect the source from being overwritten."""
        if self.kind == "photos":
            folders = {photo.parent for photo in list_photos(self.path)} | {self.path}
            return Outputs(folders=folders, overwrite=overwrite)
        folder = self.path.parent if self.path.name == SOG_META_NAME else self.path
        return Outputs(self.path, folders=[folder], scene=self.scene, overwrite=overwrite)


def _list_names(folder: Path) -> list[str] | None:
    """Return the sorted names of the entries of a folder; None if the path is not a folder or cannot be listed."""
    try:
        return sorted(os.listdir(folder))
    except OSError:
        return None

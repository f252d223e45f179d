"""Readers: a folder of posed photos, or a .zip of it -> Scene, one file a format."""

from __future__ import annotations

import os
import shlex
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path
from typing import Any

from hyrfpack.data.archive import is_archive, naming_archives, unpacked
from hyrfpack.data.cache import PictureCache
from hyrfpack.data.folder import list_photos, list_raw_photos
from hyrfpack.data.layouts import LAYOUTS
from hyrfpack.data.places import find_set
from hyrfpack.data.unusable import explain_no_photos, refuse_one_photo
from hyrfpack.errors import HyrfDataError, HyrfNoPosesError
from hyrfpack.outputs import VIDEO_SUFFIXES
from hyrfpack.scene import DEFAULT_MAX_SIZE, Scene

__all__ = ["LAYOUTS", "PictureCache", "load_scene", "pose_commands"]


def load_scene(
    path: str | os.PathLike[str],
    *,
    test_every: int = 8,
    images: str | None = None,
    layout: str | None = None,
    model: str | None = None,
    max_size: int = DEFAULT_MAX_SIZE,
    held_out: Collection[str] | None = None,
) -> Scene:
    """Read posed photos; pictures are decoded later, one by one, by `View.load`.

    Args:
        path: the folder, or a .zip (.r3d) of it, which is unpacked among the user's caches. Known layouts: COLMAP
            (`sparse/0`, `sparse`, or `colmap/sparse/0`, binary or text, beside `images/`), Blender
            (`transforms_train.json`), nerfstudio and instant-ngp (`transforms.json`), LLFF (`poses_bounds.npy`),
            Metashape (cameras as .xml), Bundler (`bundle.out`), RealityScan (camera parameters as .csv), Polycam
            (`keyframes/`) and Record3D (`metadata`). Where it holds no poses itself but one folder in it does, that is
            read. Panoramas of the whole sphere become six photos.
            Masks in `masks/` beside the photos are honoured (0 = ignored pixel).
        test_every: hold out every n-th of the sorted names, beginning with the first; 0 holds out none.
            A split of the set's own counts instead.
        images: take the photos from this folder ("images_2"); intrinsics follow the size of its files.
        layout: one of LAYOUTS, "colmap" or "nerfstudio" for instance; None takes the first of them that is there and
            says so in `Scene.notes` when there was a choice.
        model: name of the folder of a COLMAP model ("1" for `sparse/1`); None takes the one with the most photos and
            says so in `Scene.notes` when there was a choice.
        max_size: shrink photos with more pixels than this on the longer side to so many, as they are decoded; cameras
            and masks follow. 0 keeps them as they are. `Scene.notes` says how many are shrunk.
        held_out: names of the views to hold out, instead of `test_every` and of a split of the set's own.

    Returns:
        The scene in the frame and units of its files.

    Raises:
        HyrfNoPosesError: there are photos, or it is a video, and there are no poses.
        HyrfDataError: the folder cannot be used, or `held_out` names no photo or all; one sentence says what, where,
            and what to do.
        ValueError: an unknown `layout`, a negative `test_every` or `max_size`.

    Example:
        >>> import hyrfpack
        >>> scene = hyrfpack.load_scene("photos/bonsai", test_every=5)
        >>> len(scene.train), len(scene.test), scene.train[0].camera.width
        (8, 2, 48)
    """
    if test_every < 0:
        raise ValueError(f"test_every must be 0 or more, not {test_every}")
    if max_size < 0:
        raise ValueError(f"max_size must be 0 (photos as they are) or more, not {max_size}")
    if layout not in (None, *LAYOUTS):
        raise ValueError(f"no layout '{layout}'; there are {', '.join(LAYOUTS)}")
    given = Path(path)
    notes: list[str] = []
    top = _folder_of(given, notes)
    reading = {"test_every": test_every, "images": images, "layout": layout, "model": model, "max_size": max_size}
    with naming_archives():
        return _read(given, top, notes, reading, held_out)


def _read(given: Path, top: Path, notes: list[str], reading: dict[str, Any], held_out: Collection[str] | None) -> Scene:
    """`load_scene` of a folder.

    Args:
        given: the folder or archive that the user named.
        top: the folder.
        notes: sentences for the user so far.
        reading: the other arguments of `load_scene`, but `held_out`.
        held_out: as of `load_scene`.
    """
    layout, images, model = reading["layout"], reading["images"], reading["model"]
    folder, found = _find_set(top, layout, notes)
    if not found or layout not in (None, *found):
        raise _no_poses(given, folder, layout, other=bool(found))
    chosen = layout or found[0]
    reader, options = LAYOUTS[chosen], {"images": images, "model": model}
    if images is not None and "images" not in reader.options:
        raise HyrfDataError(f"{folder}: a {chosen} set names its own pictures; leave out the folder '{images}'")
    if model is not None and "model" not in reader.options:
        raise HyrfDataError(f"{folder}: the {chosen} layout has no COLMAP models to choose from; leave out '{model}'")
    wanted = {name: options[name] for name in reader.options}
    every = reading["test_every"] if held_out is None else 0
    scene = reader.read(folder, test_every=every, max_size=reading["max_size"], **wanted)
    if len(found) > 1:
        notes.append(f"poses are there as {' and '.join(found)}; {chosen} was taken")
    scene.notes[:0] = notes
    files = (*scene.files, str(given)) if is_archive(given) else scene.files
    reading = {**reading, "layout": chosen}
    if held_out is not None:
        try:
            scene = scene.with_held_out(held_out)
        except ValueError as error:
            raise HyrfDataError(f"{folder}: {error}; name other photos to hold out") from error
        reading["held_out"] = sorted(held_out)
    return replace(scene, files=files, reading={"path": os.path.abspath(given), **reading})


def _folder_of(given: Path, notes: list[str]) -> Path:
    """The folder that was given, or that the archive that was given is unpacked into, which a note says."""
    if not os.path.exists(given):  # methods of Path raise where a name is too long
        raise HyrfDataError(f"{given}: no such folder; check the path")
    if is_archive(given):
        folder = unpacked(given)
        notes.append(f"{given.name} was unpacked into {folder}, where it is found again")
        return folder
    if not os.path.isdir(given):
        if given.suffix.lower() in VIDEO_SUFFIXES:
            raise HyrfNoPosesError(f"{given}: a video has no poses; {pose_commands(given)}")
        refuse_one_photo(given)
        raise HyrfDataError(f"{given}: a file, not a folder; give the folder that holds photos and poses, or its .zip")
    return given


def _find_set(folder: Path, layout: str | None, notes: list[str]) -> tuple[Path, list[str]]:
    """The folder itself, or the one in it that holds poses, which a note says; and the layouts that they are there as.

    Where a layout is asked for, one that holds poses of that layout.
    """

    def holds(folder: Path) -> bool:
        found = _layouts_in(folder)
        return bool(found) if layout is None else layout in found

    inside = None if holds(folder) else find_set(folder, holds)
    if inside is not None:
        notes.append(f"the set in {inside.relative_to(folder)} was taken")
    return inside or folder, _layouts_in(inside or folder)


def _layouts_in(folder: Path) -> list[str]:
    """The layouts that a folder's poses are there as."""
    return [name for name, reader in LAYOUTS.items() if reader.is_there(folder)]


def _no_poses(given: Path, folder: Path, layout: str | None, other: bool) -> HyrfDataError:
    """What is to be raised where no poses are found, or just others than those of the layout that was asked for."""
    photos = [] if other or layout else list_photos(folder)
    if photos:
        return HyrfNoPosesError(f"{given}: no poses found for the {len(photos)} photos; {pose_commands(given)}")
    if not (other or layout) and list_raw_photos(folder):
        return HyrfDataError(explain_no_photos(given, folder))
    marks = [LAYOUTS[layout].mark] if layout else [reader.mark for reader in LAYOUTS.values()]
    kind = f"{layout} " if layout else ""
    return HyrfDataError(
        f"{given}: no {kind}poses found (looked for {', '.join(marks)}); give the folder that holds them"
    )


def pose_commands(path: str | os.PathLike[str]) -> str:
    """The commands that photos or a video without poses want, in words for the end of a sentence.

    Example:
        >>> pose_commands("a.mp4")
        "'hyrfpack poses a.mp4 -o SCENE' estimates them, and 'hyrfpack make a.mp4 -o scene.html' goes the whole way"
    """
    name = shlex.quote(os.fspath(path))
    return (
        f"'hyrfpack poses {name} -o SCENE' estimates them, and 'hyrfpack make {name} -o scene.html' goes the whole way"
    )

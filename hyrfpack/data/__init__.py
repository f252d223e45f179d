"""Readers that turn a folder of posed photos, or a .zip of it, into a Scene; one module for each format."""

from __future__ import annotations

import os
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path
from typing import Any

from hyrfpack.data.archive import archive_paths_in_errors, is_archive, unpack
from hyrfpack.data.cache import PictureCache
from hyrfpack.data.folder import explain_missing_path, list_photos, list_raw_photos
from hyrfpack.data.layouts import LAYOUTS
from hyrfpack.data.search import find_only_subfolder
from hyrfpack.data.unusable import no_photos_error, raise_if_single_photo
from hyrfpack.errors import HyrfDataError, HyrfError, HyrfNoPosesError, suggest_command
from hyrfpack.outputs import VIDEO_SUFFIXES
from hyrfpack.scene import DEFAULT_MAX_SIZE, DEFAULT_TEST_EVERY, MIN_MAX_SIZE, Scene, is_max_size

__all__ = ["LAYOUTS", "PictureCache", "load_scene", "pose_commands"]


def load_scene(
    path: str | os.PathLike[str],
    *,
    test_every: int = DEFAULT_TEST_EVERY,
    images: str | None = None,
    layout: str | None = None,
    model: str | None = None,
    max_size: int = DEFAULT_MAX_SIZE,
    held_out: Collection[str] | None = None,
) -> Scene:
    """Read posed photos. Pictures are decoded later, one by one, by `View.load`.

    Args:
        path: the folder, or a .zip (.r3d) of it, which is unpacked into the user's cache folder. Known layouts: COLMAP
            (`sparse/0`, `sparse`, or `colmap/sparse/0`, binary or text, beside `images/`), Blender
            (`transforms_train.json`), nerfstudio and instant-ngp (`transforms.json`), LLFF (`poses_bounds.npy`),
            Metashape (cameras as .xml), Bundler (`bundle.out`), RealityScan (camera parameters as .csv), Polycam
            (`keyframes/`) and Record3D (`metadata`). If the folder itself holds no poses but exactly one folder in it
            does, that one is read. Panoramas of the whole sphere become six photos each.
            Masks in `masks/` beside the photos are applied (0 = ignored pixel).
        test_every: hold out every n-th view of the sorted names, beginning with the first; 0 holds out none.
            If the dataset has its own split, that split is used instead.
        images: the folder to read the photos from ("images_2"); intrinsics are scaled to the size of its files.
        layout: one of LAYOUTS, for instance "colmap" or "nerfstudio". None takes the first layout that is found;
            `Scene.notes` names it if there are several.
        model: name of the folder of a COLMAP model ("1" for `sparse/1`). None takes the model with the most photos;
            `Scene.notes` names it if there are several.
        max_size: shrink photos whose longer side has more pixels to this length when they are decoded; cameras and
            masks are scaled with them. 0 keeps the stored size; other values are at least 16. `Scene.notes` states how
            many photos are shrunk.
        held_out: names of the views to hold out, instead of `test_every` and of the dataset's own split.

    Returns:
        The scene in the coordinate frame and units of its files.

    Raises:
        HyrfNoPosesError: the path holds photos, or is a video, and there are no poses.
        HyrfDataError: the folder cannot be used, or `held_out` names an unknown photo or all photos. The message says
            what is wrong, where, and what to do.
        HyrfError: `max_size` is neither 0 nor at least 16.
        ValueError: an unknown `layout`, or a negative `test_every`.

    Example:
        >>> import hyrfpack
        >>> scene = hyrfpack.load_scene("photos/bonsai", test_every=5)
        >>> len(scene.train), len(scene.test), scene.train[0].camera.width
        (8, 2, 48)
    """
    if test_every < 0:
        raise ValueError(f"test_every must be 0 or more, not {test_every}")
    if not is_max_size(max_size):
        raise HyrfError(
            f"{path}: photos cannot be shrunk to {max_size} pixels on the longer side",
            fix=f"shrink them to {MIN_MAX_SIZE} pixels or more with `max_size`, or keep their size with `max_size=0`",
        )
    if layout not in (None, *LAYOUTS):
        raise ValueError(f"no layout '{layout}'; there are {', '.join(LAYOUTS)}")
    given = Path(path)
    notes: list[str] = []
    top = _open_folder(given, notes)
    reading = {"test_every": test_every, "images": images, "layout": layout, "model": model, "max_size": max_size}
    with archive_paths_in_errors():
        return _read(given, top, notes, reading, held_out)


def _read(given: Path, top: Path, notes: list[str], reading: dict[str, Any], held_out: Collection[str] | None) -> Scene:
    """Read the scene in a folder, as described in `load_scene`.

    Args:
        given: the folder or archive that the user named.
        top: that folder, or the one that the archive was unpacked into.
        notes: sentences for the user; more are added.
        reading: the arguments of `load_scene` except `path` and `held_out`.
        held_out: as in `load_scene`.
    """
    layout, images, model = reading["layout"], reading["images"], reading["model"]
    folder, layouts = _find_posed_folder(top, layout, notes)
    if not layouts or layout not in (None, *layouts):
        raise _no_poses_error(given, folder, layout, has_other_layouts=bool(layouts))
    chosen = layout or layouts[0]
    reader, options = LAYOUTS[chosen], {"images": images, "model": model}
    if images is not None and "images" not in reader.options:
        raise HyrfDataError(
            f"{folder}: {chosen} poses state the paths of their photos, so that the folder '{images}' cannot be chosen",
            fix="leave out `images`",
        )
    if model is not None and "model" not in reader.options:
        raise HyrfDataError(
            f"{folder}: the {chosen} layout has no COLMAP models, so that '{model}' cannot be chosen",
            fix="leave out `model`",
        )
    wanted = {name: options[name] for name in reader.options}
    every = reading["test_every"] if held_out is None else 0
    scene = reader.read(folder, test_every=every, max_size=reading["max_size"], **wanted)
    if len(layouts) > 1:
        notes.append(f"there are poses in several layouts ({' and '.join(layouts)}); {chosen} is used")
    scene.notes[:0] = notes
    files = (*scene.files, str(given)) if is_archive(given) else scene.files
    reading = {**reading, "layout": chosen}
    if held_out is not None:
        try:
            scene = scene.with_held_out(held_out)
        except ValueError as error:
            raise HyrfDataError(
                f"{folder}: {error}", fix="name other photos to hold out, or choose them with `test_every`"
            ) from error
        reading["held_out"] = sorted(held_out)
    return replace(scene, files=files, reading={"path": os.path.abspath(given), **reading})


def _open_folder(given: Path, notes: list[str]) -> Path:
    """Return the user's folder; unpack an archive, add a note, and return the folder of its files."""
    if (reason := explain_missing_path(given, "folder")) is not None:
        raise HyrfDataError(f"{given}: {reason}", fix="check the path")
    if is_archive(given):
        folder = unpack(given)
        notes.append(f"{given.name} was unpacked into {folder} and is reused from there")
        return folder
    if not os.path.isdir(given):
        if given.suffix.lower() in VIDEO_SUFFIXES:
            raise HyrfNoPosesError(f"{given}: a video has no poses", fix=pose_commands(given))
        raise_if_single_photo(given)
        raise HyrfDataError(
            f"{given}: this is a file, not a folder",
            fix="give the folder that holds photos and poses, or its .zip",
        )
    return given


def _find_posed_folder(folder: Path, layout: str | None, notes: list[str]) -> tuple[Path, list[str]]:
    """Find the folder with poses, which is `folder` or the only folder below it that has poses.

    If a layout is given, only poses of that layout count. A note is added if the poses lie in a folder below `folder`.

    Returns:
        The folder, and the names of all layouts whose poses it holds.
    """

    def has_poses(folder: Path) -> bool:
        layouts = _layouts_in(folder)
        return bool(layouts) if layout is None else layout in layouts

    inside = None if has_poses(folder) else find_only_subfolder(folder, has_poses)
    if inside is not None:
        notes.append(f"the photos and poses in {inside.relative_to(folder)} are used")
    return inside or folder, _layouts_in(inside or folder)


def _layouts_in(folder: Path) -> list[str]:
    """List the layouts whose poses a folder holds."""
    return [name for name, reader in LAYOUTS.items() if reader.is_present(folder)]


def _no_poses_error(given: Path, folder: Path, layout: str | None, has_other_layouts: bool) -> HyrfDataError:
    """Return the exception for a folder without poses, or without poses of the requested layout."""
    photos = [] if has_other_layouts or layout else list_photos(folder)
    if photos:
        return HyrfNoPosesError(f"{given}: no poses found for the {len(photos)} photos", fix=pose_commands(given))
    if not (has_other_layouts or layout) and list_raw_photos(folder):
        return no_photos_error(given, folder)
    files = [LAYOUTS[layout].files] if layout else [reader.files for reader in LAYOUTS.values()]
    kind = f"{layout} " if layout else ""
    return HyrfDataError(
        f"{given}: no {kind}poses found (looked for {', '.join(files)})",
        fix="name the folder that holds the poses",
    )


def pose_commands(path: str | os.PathLike[str]) -> str:
    """Name the commands that process photos or a video without poses, as the end of a sentence.

    Example:
        >>> pose_commands("a.mp4")
        "'hyrfpack poses a.mp4 -o SCENE' estimates them, and 'hyrfpack make a.mp4 -o scene.html' runs all stages"
    """
    poses = suggest_command("poses", os.fspath(path), "-o", "SCENE")
    make = suggest_command("make", os.fspath(path), "-o", "scene.html")
    return f"{poses} estimates them, and {make} runs all stages"

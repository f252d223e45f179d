"""Readers: a folder of posed photos -> Scene, one file a format."""

from __future__ import annotations

import os
from pathlib import Path

from hyrfpack.data.cache import PictureCache
from hyrfpack.errors import HyrfDataError
from hyrfpack.scene import DEFAULT_MAX_SIZE, Scene

__all__ = ["PictureCache", "load_scene"]


def load_scene(
    path: str | os.PathLike[str],
    *,
    test_every: int = 8,
    images: str | None = None,
    layout: str | None = None,
    model: str | None = None,
    max_size: int = DEFAULT_MAX_SIZE,
) -> Scene:
    """Read a folder of posed photos; pictures are decoded later, one by one, by `View.load`.

    Args:
        path: the folder. Known layouts: COLMAP (`sparse/0`, `sparse`, or `colmap/sparse/0`, binary or text, beside
            `images/`), Blender (`transforms_train.json`), nerfstudio and instant-ngp (`transforms.json`).
            Masks in `masks/` beside the photos are honoured (0 = ignored pixel).
        test_every: hold out every n-th of the sorted names, beginning with the first; 0 holds out none.
            A split of the set's own counts instead.
        images: take the photos from this folder ("images_2"); intrinsics follow the size of its files.
        layout: "colmap", "blender" or "nerfstudio"; None takes the first of these that is there and says so in
            `Scene.notes` when there was a choice.
        model: name of the folder of a COLMAP model ("1" for `sparse/1`); None takes the one with the most photos and
            says so in `Scene.notes` when there was a choice.
        max_size: shrink photos with more pixels than this on the longer side to so many, as they are decoded; cameras
            and masks follow. 0 keeps them as they are. `Scene.notes` says how many are shrunk.

    Returns:
        The scene in the frame and units of its files.

    Raises:
        HyrfDataError: the folder cannot be used; one sentence says what, where, and what to do.
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
    if layout not in (None, "colmap", "blender", "nerfstudio"):
        raise ValueError(f"no layout '{layout}'; there are colmap, blender, nerfstudio")
    folder = Path(path)
    if not os.path.exists(folder):  # methods of Path raise where a name is too long
        raise HyrfDataError(f"{folder}: no such folder; check the path")
    if not os.path.isdir(folder):
        raise HyrfDataError(f"{folder}: a file, not a folder; give the folder that holds photos and poses")

    from hyrfpack.data.blender import read_blender
    from hyrfpack.data.colmap import find_models, read_colmap
    from hyrfpack.data.nerfstudio import read_nerfstudio

    there = {
        "colmap": bool(find_models(folder)),
        "blender": os.path.isfile(folder / "transforms_train.json"),
        "nerfstudio": os.path.isfile(folder / "transforms.json"),
    }
    found = [name for name, present in there.items() if present]
    if not found or (layout is not None and not there[layout]):
        raise HyrfDataError(
            f"{folder}: no {layout + ' ' if layout else ''}poses found (looked for a COLMAP model in sparse/0, "
            "transforms_train.json and transforms.json); give the folder that holds them"
        )
    chosen = layout or found[0]
    if chosen == "blender" and images is not None:
        raise HyrfDataError(f"{folder}: a Blender-style set names its own pictures; leave out the folder '{images}'")
    if chosen != "colmap" and model is not None:
        raise HyrfDataError(f"{folder}: the {chosen} layout has no COLMAP models to choose from; leave out '{model}'")
    if chosen == "colmap":
        scene = read_colmap(folder, test_every=test_every, images=images, model=model, max_size=max_size)
    elif chosen == "blender":
        scene = read_blender(folder, test_every=test_every, max_size=max_size)
    else:
        scene = read_nerfstudio(folder, test_every=test_every, images=images, max_size=max_size)
    if len(found) > 1:
        scene.notes.insert(0, f"poses are there as {' and '.join(found)}; {chosen} was taken")
    return scene

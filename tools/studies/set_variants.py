"""Make harder variants of data sets, with few photos or with photos in two groups of exposure.

The name of a variant is that of the set, with the changes after "@":

    bonsai@25                  25 of the training photos, evenly spread over their names
    bonsai@contiguous          the second half of all photos, by name, two stops lighter
    bonsai@interleaved         half of all photos, mixed with the others by name, two stops lighter
    bonsai@25@contiguous       both changes

The poses, the points and the choice of held-out photos are those of the set. A tone curve makes photos lighter
(`hyrfpack.model.exposure.apply_exposure_gains`), held-out ones like their neighbours.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

import hyrfpack
from hyrfpack.errors import HyrfError
from hyrfpack.format.exposure_header import STOPS_PER_LOG_GAIN
from hyrfpack.model.exposure import apply_exposure_gains
from hyrfpack.scene import Picture, Scene, View, evenly_spaced

SECOND_GROUP_STOPS = 2.0  # the second group of photos is this much lighter than the first


def load_variant(data: Path, name: str) -> Scene:
    """Read a variant of a data set below `data`, with the changes that its name gives.

    Raises:
        HyrfError: a change is unknown, or the data set cannot be read.
    """
    folder, *changes = name.split("@")
    scene = hyrfpack.load_scene(data / folder)
    for change in changes:
        if change.isdecimal() and int(change) > 0:
            scene = keep_few_photos(scene, int(change))
        elif change in ("contiguous", "interleaved"):
            scene = split_exposures(scene, interleaved=change == "interleaved")
        else:
            problem = f"'{name}': there is no change '{change}' of a data set"
            raise HyrfError(problem, fix="name a number of photos, 'contiguous' or 'interleaved' after the @")
    return scene


def keep_few_photos(scene: Scene, count: int) -> Scene:
    """Return the scene with `count` of its training photos, evenly spread."""
    train = evenly_spaced(scene.train, count)
    kept_names = {view.name for view in (*train, *scene.test)}
    return replace(
        scene, train=train, tracks={name: rows for name, rows in scene.tracks.items() if name in kept_names}
    )  # fmt: skip


def split_exposures(scene: Scene, *, interleaved: bool) -> Scene:
    """Return the scene with half of its photos lighter by `SECOND_GROUP_STOPS`.

    With `interleaved`, photo number n by name is lighter if the sum of the bits of n is odd (the Thue-Morse sequence).
    So both groups have held-out photos, which are every 8th. Otherwise the second half by name is lighter.
    """
    names = sorted(view.name for view in scene.views)
    lightened = {
        name for n, name in enumerate(names) if (n.bit_count() % 2 if interleaved else n >= len(names) // 2)
    }  # fmt: skip

    def change(views: list[View]) -> list[View]:
        return [_lighten(view) if view.name in lightened else view for view in views]

    return replace(scene, train=change(scene.train), test=change(scene.test))


def _lighten(view: View) -> View:
    gains = torch.full((3,), float(np.exp(SECOND_GROUP_STOPS / STOPS_PER_LOG_GAIN)), dtype=torch.float64)

    def load() -> Picture:
        picture = view.load()
        exposed = apply_exposure_gains(torch.from_numpy(picture.rgb).double() / 255, gains)
        return replace(picture, rgb=(exposed * 255).round().byte().numpy())

    return replace(view, load=load)

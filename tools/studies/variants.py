"""Sets made harder: few photos, or photos in two groups of exposure. Named after the set:

    bonsai@25                  25 of its training photos, evenly spread over their names
    bonsai@contiguous          the second half of all photos, by name, two stops lighter
    bonsai@interleaved         half of all photos two stops lighter, one here and one there
    bonsai@25@contiguous       both

Poses and points are the set's own, and held-out photos are the same ones. Photos are made lighter by a tone curve
(`hyrfpack.model.exposure.apply_exposure_gains`), held-out ones like their neighbours.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

import hyrfpack
from hyrfpack.format.exposure_header import STOPS_PER_LOG_GAIN
from hyrfpack.model.exposure import apply_exposure_gains
from hyrfpack.scene import Picture, Scene, View, evenly_spaced

SECOND_GROUP_STOPS = 2.0  # by which it is lighter than the first


def load_variant(data: Path, name: str) -> Scene:
    """Read a set below `data`, changed as its name says.

    Raises:
        ValueError: there is no such change.
        HyrfDataError: as `hyrfpack.load_scene`.
    """
    folder, *changes = name.split("@")
    scene = hyrfpack.load_scene(data / folder)
    for change in changes:
        if change.isdecimal() and int(change) > 0:
            scene = with_few_photos(scene, int(change))
        elif change in ("contiguous", "interleaved"):
            scene = in_two_exposures(scene, interleaved=change == "interleaved")
        else:
            raise ValueError(f"'{name}': the change '{change}' is not a number, 'contiguous' or 'interleaved'")
    return scene


def with_few_photos(scene: Scene, count: int) -> Scene:
    """The scene with `count` of its training photos, evenly spread."""
    train = evenly_spaced(scene.train, count)
    kept = {view.name for view in (*train, *scene.test)}
    return replace(
        scene, train=train, tracks={name: rows for name, rows in scene.tracks.items() if name in kept}
    )  # fmt: skip


def in_two_exposures(scene: Scene, *, interleaved: bool) -> Scene:
    """The scene with half of its photos lighter by `SECOND_GROUP_STOPS`.

    Interleaved, the photo number n by name is lighter if the bits of n have an odd sum (Thue-Morse), so that held-out
    photos, one of every eight, are in both groups.
    """
    names = sorted(view.name for view in scene.views)
    lighter = {
        name for n, name in enumerate(names) if (n.bit_count() % 2 if interleaved else n >= len(names) // 2)
    }  # fmt: skip

    def change(views: list[View]) -> list[View]:
        return [_lighter(view) if view.name in lighter else view for view in views]

    return replace(scene, train=change(scene.train), test=change(scene.test))


def _lighter(view: View) -> View:
    gains = torch.full((3,), float(np.exp(SECOND_GROUP_STOPS / STOPS_PER_LOG_GAIN)), dtype=torch.float64)

    def load() -> Picture:
        picture = view.load()
        exposed = apply_exposure_gains(torch.from_numpy(picture.rgb).double() / 255, gains)
        return replace(picture, rgb=(exposed * 255).round().byte().numpy())

    return replace(view, load=load)

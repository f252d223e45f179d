"""What is exported: a model, and from where it was photographed."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, replace

import numpy as np

from hyrfpack.cameras.capture import Capture
from hyrfpack.cameras.paths import Viewpoint, common_direction, look_at, orbit
from hyrfpack.cameras.view_sampling import interpolate_views
from hyrfpack.errors import HyrfDataError, HyrfError
from hyrfpack.evaluate.metrics import stated_error
from hyrfpack.format import describe, load
from hyrfpack.model import HybridModel
from hyrfpack.scene import Camera, Scene, View, evenly_spaced

FITTED = 256  # cameras at most that colours are fitted at: each takes memory and time
MEASURED = 12  # views at most that a loss is measured at
HELD_OUT = 8  # every so many of the cameras that a file keeps are not fitted, but measured at
FEW = 16  # cameras, of which none can be spared
BETWEEN = 4  # places beside each coarse camera that are fitted, too
RING, LIFTS = 24, (-0.2, 0.0, 0.2)  # cameras around what kept none: in rings, raised by so much of their distance
TURNED = 0.5  # length of the mean downward direction up to which pictures count as turned against each other


@dataclass(frozen=True)
class Source:
    """A model and what is known of how it was photographed.

    Attributes:
        model: the model.
        cameras: those it was trained on, by name; empty where the file keeps none and there are no photos.
        coarse: whether they are only about where these were, as small files keep them: not to train on.
        fitted: those that colours shall be fitted at; where none are known, some around what the model shows.
        measured: cameras to measure at, with their photos where there are any. None of them is fitted, but where
            there are fewer than FEW in all.
        up, center: (3,) which way is up, unit length, and what is looked at, world units.
        error: mean squared error of its pictures against its photos, by its own account.
    """

    model: HybridModel
    cameras: list[tuple[str, Camera]]
    fitted: list[Camera]
    measured: list[tuple[Camera, View | None]]
    up: np.ndarray
    center: np.ndarray
    error: float
    coarse: bool = False

    @classmethod
    def read(cls, path: str | os.PathLike[str], data: Scene | None = None) -> Source:
        """Read a `.hyrf` file; cameras are those of the photos, if given, or those that the file keeps.

        Raises:
            HyrfError: the file cannot be read, or there is no Gaussian in it.
        """
        facts, model = describe(path), load(path)
        if not len(model):
            raise HyrfError(f"{path}: there is no Gaussian in it, so there is nothing to export; train it again")
        capture = Capture(facts, data)
        try:
            viewpoint = capture.viewpoint
        except HyrfDataError as error:  # photos are no way round it here
            why = error.__cause__
            raise HyrfDataError(f"{path}: its viewpoint cannot be used ({why!s:.160}); train the model again") from why
        up, center = viewpoint.up / math.hypot(*viewpoint.up), viewpoint.center
        stated = stated_error(facts["provenance"])
        cameras = capture.cameras
        measured: list[tuple[Camera, View | None]]
        if data is not None and data.train:
            named = [(view.name, view.camera) for view in data.train]
            measured = [(view.camera, view) for view in evenly_spaced(data.test, MEASURED)]
            fitted = evenly_spaced(cameras, FITTED)
            return cls(model, named, fitted, measured, _up_of(cameras, up), center, stated)
        if capture.is_synthetic:
            between = evenly_spaced(cameras[1::2], MEASURED)  # of an orbit with twice as many cameras as RING
            measured = [(camera, None) for camera in between]
            return cls(model, [], _around(viewpoint, center, up), measured, up, center, stated)
        named = [(f"{number:04d}.png", camera) for number, camera in enumerate(cameras)]
        spare = cameras[::HELD_OUT] if len(cameras) >= FEW else cameras
        fitted = [c for number, c in enumerate(cameras) if number % HELD_OUT] if len(cameras) >= FEW else cameras
        measured = [(camera, None) for camera in evenly_spaced(spare, MEASURED)]
        if capture.is_coarse:
            # Too few to fit harmonics to by themselves: what lies between them counts more than where they stand.
            between = [camera for seed in range(BETWEEN) for camera in interpolate_views(cameras, seed)]
            fitted = [*cameras, *between, *_around(viewpoint, center, up)]
        return cls(model, named, fitted, measured, _up_of(cameras, up), center, stated, capture.is_coarse)


def _up_of(cameras: list[Camera], up: np.ndarray) -> np.ndarray:
    """Which way is up, unit length: for cameras that look down on a flat scene and turn, as drones do, against them."""
    forward = common_direction(cameras)
    downward = np.mean([camera.rotation[1] for camera in cameras], axis=0)
    return up if forward is None or np.linalg.norm(downward) >= TURNED else -forward


def _around(viewpoint: Viewpoint, center: np.ndarray, up: np.ndarray) -> list[Camera]:
    """Where a scene may have been photographed from: rings about it, at several heights."""
    cameras = []
    for camera in orbit(viewpoint, RING):
        distance = np.linalg.norm(camera.position - center)
        for lift in LIFTS:
            pose = look_at(camera.position + lift * distance * up, center, up)
            cameras.append(replace(camera, camera_from_world=pose))
    return cameras

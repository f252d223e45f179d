"""Where a model is looked at from to measure what its parts do to pictures: between its cameras, in small pictures."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from hyrfpack.scene import Camera

LONGEST_SIDE = 512  # pixels of pictures in which light is measured
WIDER = 1.4  # sides of the pictures between the cameras: what lies just outside the photos is seen too
_NEAREST = 3  # neighbours that a camera is moved towards
_TURN = 10.0  # what a turn by a radian counts as in finding them, in median distances between neighbours


def views_at_and_between(cameras: Sequence[Camera], count: int, seed: int = 0) -> tuple[list[Camera], list[Camera]]:
    """A few views that stand for all that a scene is looked at from: `count` cameras at most, and as many between.

    They lie in the middle of equal parts of all cameras: the first and the last, where a way around the scene begins
    and ends, stand for the fewest. Those between are on the way to a neighbour among all cameras, see `views_between`.
    """
    count = min(count, len(cameras))
    places = [(2 * part + 1) * len(cameras) // (2 * count) for part in range(count)]
    return [cameras[place] for place in places], views_between(cameras, seed, places)


def views_between(cameras: Sequence[Camera], seed: int = 0, some: Sequence[int] | None = None) -> list[Camera]:
    """For each camera one on the way to a neighbour that looks the same way, with a wider picture.

    What held-out photos see lies between the photos and just beside them.

    Args:
        cameras: among which neighbours are looked for.
        seed: of the neighbours and of how far it is on the way to them.
        some: indices of the cameras that a view is made for; None for all.
    """
    some = list(range(len(cameras)) if some is None else some)
    if len(cameras) < 2:
        return [cameras[index] for index in some]
    rng = np.random.default_rng(seed)
    places = np.array([camera.position for camera in cameras])
    turns = Rotation.from_matrix(np.array([camera.rotation for camera in cameras]))
    apart = np.linalg.norm(places[some, None] - places, axis=2)
    apart[np.arange(len(some)), some] = np.inf  # from itself
    unit = float(np.median(apart.min(axis=1))) or 1.0
    made = []
    for row, index in enumerate(some):
        camera = cameras[index]
        cost = apart[row] + _TURN * unit * (turns[index].inv() * turns).magnitude()
        other = np.argsort(cost, kind="stable")[rng.integers(min(_NEAREST, len(cameras) - 1))]
        share = rng.uniform(0.25, 0.75)
        turn = Slerp((0, 1), Rotation.concatenate([turns[index], turns[other]]))(share).as_matrix()
        pose = np.eye(4)
        pose[:3, :3] = turn
        pose[:3, 3] = -turn @ ((1 - share) * places[index] + share * places[other])
        made.append(_wider(dataclasses.replace(camera, camera_from_world=pose)))
    return made


def small_camera(camera: Camera, longest: int = LONGEST_SIDE) -> Camera:
    """The same view in a picture of at most `longest` pixels a side: enough to learn what can be seen from there."""
    shrink = min(1.0, longest / max(camera.width, camera.height))
    width, height = max(1, round(camera.width * shrink)), max(1, round(camera.height * shrink))
    x, y = width / camera.width, height / camera.height
    return dataclasses.replace(
        camera, width=width, height=height, fx=camera.fx * x, fy=camera.fy * y, cx=camera.cx * x, cy=camera.cy * y
    )


def _wider(camera: Camera) -> Camera:
    width, height = round(WIDER * camera.width), round(WIDER * camera.height)
    return dataclasses.replace(
        camera,
        width=width,
        height=height,
        cx=camera.cx + (width - camera.width) / 2,
        cy=camera.cy + (height - camera.height) / 2,
    )

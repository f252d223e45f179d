"""What a trained model keeps of its photos: their cameras, what it will be looked at from, about, and their size."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hyrfpack.cameras.files import focal_length, side_length
from hyrfpack.cameras.paths import orbit, stored_viewpoint
from hyrfpack.errors import HyrfDataError
from hyrfpack.scene import DEFAULT_MAX_SIZE, Camera, Scene, evenly_spaced

KEPT = 128  # cameras that a trained model keeps
ORBIT = 48  # cameras around a model that kept none


def capture_of(cameras: Sequence[Camera]) -> list[list[float]]:
    """Up to KEPT of the cameras, evenly spread, as JSON: [width, height, fx, fy, cx, cy, 3 x 4 camera_from_world]."""
    return [
        [c.width, c.height, *map(_rounded, (*c.intrinsics, *c.camera_from_world[:3].ravel()))]
        for c in evenly_spaced(cameras, KEPT)
    ]


def _rounded(number: float) -> float:
    """To nine digits, or where these are not six behind the point, as with map coordinates, to six."""
    return float(f"{number:.9g}") if abs(number) < 1000 else round(float(number), 6)


def stored_cameras(facts: dict) -> list[Camera]:
    """The cameras that a model keeps, or else an orbit about what it shows.

    Args:
        facts: from `hyrfpack.describe`.

    Raises:
        HyrfDataError: they make no sense.
    """
    capture = facts["provenance"].get("cameras")
    if not capture:
        return orbit(stored_viewpoint(facts), ORBIT)
    try:
        return [
            Camera(
                side_length(width),
                side_length(height),
                focal_length(fx),
                focal_length(fy),
                float(cx),
                float(cy),
                np.reshape(pose, (3, 4)),
            )
            for width, height, fx, fy, cx, cy, *pose in capture
        ]
    except (TypeError, ValueError, ArithmeticError) as error:
        raise HyrfDataError(
            f"the cameras that the file keeps make no sense ({error!s:.160}); name the photos with --data"
        ) from error


def max_size_of(scene: Scene) -> int | None:
    """The limit on the size of photos that a model trained on a scene keeps as "max_size" of its provenance.

    None, for nothing, where reading them again with DEFAULT_MAX_SIZE gives the same pictures: a model of small photos
    is the same file, byte for byte, whether or not there is such a limit.
    """
    small = all(max(view.camera.width, view.camera.height) < DEFAULT_MAX_SIZE for view in scene.views)
    return None if small and scene.max_size == DEFAULT_MAX_SIZE else scene.max_size


def stored_max_size(facts: dict) -> int:
    """The `max_size` of `load_scene` that gives photos the size which a model was trained at.

    Args:
        facts: from `hyrfpack.describe`. DEFAULT_MAX_SIZE where they say nothing of use.
    """
    stored = facts["provenance"].get("max_size")
    usable = isinstance(stored, int) and not isinstance(stored, bool) and stored >= 0
    return stored if usable else DEFAULT_MAX_SIZE

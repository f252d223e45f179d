"""What a trained model keeps of its photos: cameras, viewpoint and size."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np

from hyrfpack.cameras.files import camera_from_numbers, camera_to_numbers
from hyrfpack.cameras.paths import Viewpoint, orbit
from hyrfpack.errors import HyrfDataError
from hyrfpack.scene import DEFAULT_MAX_SIZE, Camera, Scene, evenly_spaced

KEPT = 128  # cameras that a trained model keeps
ORBIT = 48  # cameras around a model that kept none
COARSE = 14  # cameras that a small file keeps
FINE = 500  # of the parts of the scene's box that they are right to, about

# A kept camera is found among others within this part of the scene's box and this angle. Two sets of photos may share a
# few cameras by chance: the first of many sets stands at the origin.
_SAME_PLACE_SCALE, _SAME_DIRECTION_DEGREES = 5 / FINE, 3.0
_MIN_FOUND_SHARE = 0.25  # of the kept cameras; with fewer, the photos are not those of training


def kept_cameras(cameras: Sequence[Camera]) -> list[list[float]]:
    """Up to KEPT of the cameras, evenly spread, as the "cameras" of a provenance: see `camera_to_numbers`."""
    return [camera_to_numbers(camera) for camera in evenly_spaced(cameras, KEPT)]


def provenance_of(scene: Scene) -> dict:
    """What the provenance of a model trained on a scene keeps of it, for `Capture`.

    `max_size` is left out where reading the photos again with DEFAULT_MAX_SIZE gives the same pictures: a model of
    small photos is the same file, byte for byte, whether or not there is such a limit.
    """
    cameras = [view.camera for view in scene.train]
    kept: dict = {"viewpoint": Viewpoint.of(cameras).to_json(), "cameras": kept_cameras(cameras)}
    small = all(max(view.camera.width, view.camera.height) < DEFAULT_MAX_SIZE for view in scene.views)
    needless = scene.max_size is None or (small and scene.max_size == DEFAULT_MAX_SIZE)
    if not needless:
        kept["max_size"] = scene.max_size
    return kept


def coarse(provenance: dict, scale: float) -> dict:
    """A provenance as small files carry it: "coarse_cameras" instead of "cameras", and no more digits than it takes.

    They are COARSE of the cameras, evenly spread, and stand where those stood to about 1 / FINE of the scene: enough to
    look from there, not to train on. What cannot be read is left out.

    Args:
        scale: of the scene's box, world units.
    """
    kept = {name: value for name, value in provenance.items() if name != "cameras"}
    with suppress(TypeError, ValueError, ArithmeticError, KeyError):
        kept["viewpoint"] = Viewpoint.from_json(provenance["viewpoint"]).to_json(rounded=True)
    with suppress(TypeError, ValueError, ArithmeticError, KeyError):
        cameras = evenly_spaced([camera_from_numbers(numbers) for numbers in provenance["cameras"]], COARSE)
        farthest = max((float(np.linalg.norm(camera.position)) for camera in cameras), default=0.0)
        # A rotation that is rounded moves the camera by as much of its distance from the origin.
        places = (
            int(np.clip(np.ceil(np.log10(max(2 * farthest / scale, 1e-9) * FINE)), 4, 9)),
            int(np.clip(np.ceil(np.log10(FINE / scale)), 0, 9)),
        )
        kept["coarse_cameras"] = [camera_to_numbers(camera, places) for camera in cameras]
    return kept


def has_mean_exposure(provenance: dict) -> bool:
    """Whether a model has its photos' mean exposure and no exposure map, as an earlier version wrote it.

    What differs between its renders and a photo is the photo's own exposure, too.
    """
    return provenance.get("mean_exposure") is True


@dataclass(frozen=True)
class Capture:
    """How a model was photographed, by its file or by photos at hand. Nothing is read of it before it is asked for.

    Attributes:
        facts: from `hyrfpack.describe`, which lies floors above: the caller asks it.
        scene: photos of the same; without photos to train on it counts for nothing.
    """

    facts: dict
    scene: Scene | None = None

    @property
    def cameras(self) -> list[Camera]:
        """Those of the photos to train on, or else those that the file keeps, coarse ones if it has no others, or else
        an orbit about what it shows.

        Raises:
            HyrfDataError: what the file says makes no sense.
        """
        if self._photographed:
            return self._photographed
        if self.made_up:
            return orbit(self.viewpoint, ORBIT)
        try:
            return [camera_from_numbers(numbers) for numbers in self._kept or self._coarse]
        except (TypeError, ValueError, ArithmeticError) as error:
            raise HyrfDataError(
                f"the cameras that the file keeps are not valid ({error!s:.160}); name the photos with `data`"
            ) from error

    @property
    def made_up(self) -> bool:
        """Whether `cameras` is an orbit, because no camera is known."""
        return not (self._photographed or self._kept or self._coarse)

    @property
    def is_coarse(self) -> bool:
        """Whether `cameras` are only about where photos were taken from, see `coarse`."""
        return bool(not (self._photographed or self._kept) and self._coarse)

    @property
    def viewpoint(self) -> Viewpoint:
        """The one that the file keeps, or else one that follows from the model's frame alone.

        Raises:
            HyrfDataError: what the file says makes no sense.
        """
        stored, frame = self.facts["provenance"].get("viewpoint"), self.facts["config"]["frame"]
        try:
            if stored is None:
                return Viewpoint.of_frame(frame["center"], frame["scale"])
            return Viewpoint.from_json(stored)
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise HyrfDataError(
                f"the model's viewpoint cannot be used ({error}); render with `data` or `cameras` instead"
            ) from error

    @property
    def mismatch(self) -> str:
        """One sentence if the cameras of the photos are not those that the file keeps of its training: another scene,
        or another coordinate frame. "" where they are, and where there are no photos or the file keeps no cameras.

        Names of photos are not compared: files keep none, and photos whose poses were estimated anew keep theirs.
        """
        if self.scene is None:
            return ""
        views = self.scene.views
        try:
            kept = [camera_from_numbers(numbers) for numbers in self._kept or self._coarse or ()]
            limit = _SAME_PLACE_SCALE * float(self.facts["config"]["frame"]["scale"])
        except (TypeError, ValueError, ArithmeticError, KeyError):
            return ""
        if not (views and kept):
            return ""
        places = np.array([view.camera.position for view in views])
        directions = np.array([view.camera.forward for view in views])
        least_cosine = np.cos(np.radians(_SAME_DIRECTION_DEGREES))
        found = sum(
            bool(
                np.any(
                    (np.linalg.norm(places - c.position, axis=1) <= limit) & (directions @ c.forward >= least_cosine)
                )
            )
            for c in kept
        )
        if found >= _MIN_FOUND_SHARE * len(kept):
            return ""
        return (
            f"{self.scene.path}: of the {len(kept)} cameras that the model keeps of its training, {found or 'none'} "
            f"{'are' if found > 1 else 'is'} among those of these photos, which may show another scene or have poses "
            "in another coordinate frame; name the photos and poses that it was trained on"
        )

    @property
    def max_size(self) -> int:
        """The `max_size` of `load_scene` that gives photos the size which the model was trained at.

        DEFAULT_MAX_SIZE where the file says nothing of use.
        """
        stored = self.facts["provenance"].get("max_size")
        usable = isinstance(stored, int) and not isinstance(stored, bool) and stored >= 0
        return stored if usable else DEFAULT_MAX_SIZE

    @property
    def _kept(self) -> Any:
        return self.facts["provenance"].get("cameras")

    @property
    def _coarse(self) -> Any:
        return self.facts["provenance"].get("coarse_cameras")

    @property
    def _photographed(self) -> list[Camera]:
        return [] if self.scene is None else [view.camera for view in self.scene.train]

"""What a trained model keeps of its photos: cameras, viewpoint and size, and whether it has their mean exposure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from hyrfpack.cameras.files import camera_from_numbers, camera_to_numbers
from hyrfpack.cameras.paths import Viewpoint, orbit
from hyrfpack.errors import HyrfDataError
from hyrfpack.scene import DEFAULT_MAX_SIZE, Camera, Scene, evenly_spaced

KEPT = 128  # cameras that a trained model keeps
ORBIT = 48  # cameras around a model that kept none


def kept_cameras(cameras: Sequence[Camera]) -> list[list[float]]:
    """Up to KEPT of the cameras, evenly spread, as the "cameras" of a provenance: see `camera_to_numbers`."""
    return [camera_to_numbers(camera) for camera in evenly_spaced(cameras, KEPT)]


def provenance_of(scene: Scene, mean_exposure: bool = False) -> dict:
    """What the provenance of a model trained on a scene keeps of it, for `Capture` and `has_mean_exposure`.

    `max_size` is left out where reading the photos again with DEFAULT_MAX_SIZE gives the same pictures: a model of
    small photos is the same file, byte for byte, whether or not there is such a limit. So is `mean_exposure` where no
    gains of photos were learnt.
    """
    cameras = [view.camera for view in scene.train]
    kept: dict = {"viewpoint": Viewpoint.of(cameras).to_json(), "cameras": kept_cameras(cameras)}
    small = all(max(view.camera.width, view.camera.height) < DEFAULT_MAX_SIZE for view in scene.views)
    needless = scene.max_size is None or (small and scene.max_size == DEFAULT_MAX_SIZE)
    if not needless:
        kept["max_size"] = scene.max_size
    return {**kept, "mean_exposure": True} if mean_exposure else kept


def has_mean_exposure(provenance: dict) -> bool:
    """Whether a model has its photos' mean exposure, gains of each having been learnt beside it, by its provenance.

    Where it has, what differs between a render and a photo is the photo's own exposure, too.
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
        """Those of the photos to train on, or else those that the file keeps, or else an orbit about what it shows.

        Raises:
            HyrfDataError: what the file says makes no sense.
        """
        if self._photographed:
            return self._photographed
        if self.made_up:
            return orbit(self.viewpoint, ORBIT)
        try:
            return [camera_from_numbers(numbers) for numbers in self.facts["provenance"]["cameras"]]
        except (TypeError, ValueError, ArithmeticError) as error:
            raise HyrfDataError(
                f"the cameras that the file keeps are not valid ({error!s:.160}); name the photos with --data"
            ) from error

    @property
    def made_up(self) -> bool:
        """Whether `cameras` is an orbit, because no camera is known."""
        return not (self._photographed or self.facts["provenance"].get("cameras"))

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
                f"the model's viewpoint cannot be used ({error}); render with --data or --cameras instead"
            ) from error

    @property
    def max_size(self) -> int:
        """The `max_size` of `load_scene` that gives photos the size which the model was trained at.

        DEFAULT_MAX_SIZE where the file says nothing of use.
        """
        stored = self.facts["provenance"].get("max_size")
        usable = isinstance(stored, int) and not isinstance(stored, bool) and stored >= 0
        return stored if usable else DEFAULT_MAX_SIZE

    @property
    def _photographed(self) -> list[Camera]:
        return [] if self.scene is None else [view.camera for view in self.scene.train]

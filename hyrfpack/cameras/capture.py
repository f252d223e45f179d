"""The capture data that a trained model stores: cameras, viewpoint and photo size."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, overload

import numpy as np

from hyrfpack.cameras.files import camera_from_numbers, camera_to_numbers
from hyrfpack.cameras.paths import Viewpoint, orbit
from hyrfpack.cameras.placement import Placement
from hyrfpack.cameras.sampling import (
    COARSE_RATE_RATIO,
    MAX_RATE_RATIO,
    MAX_SAMPLING_CAMERAS,
    RATE_RATIO_KEY,
    select_representative_cameras,
    stored_rate_ratio,
)
from hyrfpack.errors import HyrfDataError
from hyrfpack.rotations import IDENTITY
from hyrfpack.scene import DEFAULT_MAX_SIZE, Camera, Scene, View, evenly_spaced, is_max_size

MAX_STORED_CAMERAS = MAX_SAMPLING_CAMERAS
MIN_COARSE_CAMERAS = 14
FALLBACK_ORBIT_CAMERAS = 48
COARSE_POSE_STEPS_PER_SCENE_SCALE = 500
MAX_COARSE_DECIMALS = 35  # of positions; enough for the smallest world that a frame can have, of scale 1e-30

# The key of a provenance that says what changed the model after its `psnr` was measured, and its values. An edit, which
# changes more than compression, takes the place of the other value.
PSNR_BEFORE_KEY = "psnr_before"
PSNR_BEFORE_COMPRESSION = "compression"
PSNR_BEFORE_EDIT = "an edit"

# The key of a provenance that says where edits have moved the model: a `Placement` that maps world coordinates of its
# photos' poses to those of the model.
PLACEMENT_KEY = "placement"

MISMATCH_REMEDY = "name the photos and poses that it was trained on"
LEAK_REMEDY = "hold out the same photos as in training, with `test_every`"
# A stored camera matches a photo's camera that differs from it by no more than these two limits.
_MAX_MATCH_DISTANCE_SCENE_SCALES = 5 / COARSE_POSE_STEPS_PER_SCENE_SCALE
_MAX_MATCH_ANGLE_DEGREES = 3.0
_MIN_LEAK_MARGIN = 0.3  # of the limits above; coarse positions are rounded by up to 0.2 of them
# With a lower share of matched cameras, the photos are not those of training. The share is above zero because two
# scenes may have a few cameras in common by chance: the first camera of many scenes stands at the origin.
_MIN_MATCHED_CAMERA_SHARE = 0.25


def provenance_cameras(cameras: Sequence[Camera]) -> list[list[float]]:
    """Select up to MAX_STORED_CAMERAS evenly spaced cameras as the "cameras" of a provenance.

    Each camera becomes a list of numbers, see `camera_to_numbers`.
    """
    return [camera_to_numbers(camera) for camera in evenly_spaced(cameras, MAX_STORED_CAMERAS)]


def scene_provenance(scene: Scene) -> dict:
    """Collect what a trained model's provenance stores of its scene: viewpoint, cameras and `max_size`.

    `Capture` reads it back. Of more than MAX_STORED_CAMERAS cameras, those that represent all are kept, with their rate
    ratio (`hyrfpack.cameras.sampling`). `max_size` is left out if photos read with DEFAULT_MAX_SIZE give the same
    pictures. So a model of small photos is the same file, byte for byte, with and without a size limit.
    """
    cameras = [view.camera for view in scene.train]
    points = scene.points
    # The unit is so small that the near plane hides nothing, wherever the origin lies.
    unit = float(np.std(points, axis=0).max(initial=0)) / 100 if len(points) else 0.0
    stored, ratio = select_representative_cameras(cameras, points, unit or 1.0, MAX_STORED_CAMERAS, MAX_STORED_CAMERAS)
    provenance: dict = {"viewpoint": Viewpoint.from_cameras(cameras).to_json(), "cameras": provenance_cameras(stored)}
    if ratio > 1:
        provenance[RATE_RATIO_KEY] = _rounded_ratio(ratio)
    is_small = all(max(view.camera.width, view.camera.height) < DEFAULT_MAX_SIZE for view in scene.views)
    is_redundant = scene.max_size is None or (is_small and scene.max_size == DEFAULT_MAX_SIZE)
    if not is_redundant:
        provenance["max_size"] = scene.max_size
    return provenance


def quantized_provenance(provenance: dict, scale: float, points: np.ndarray | None = None) -> dict:
    """Shorten a provenance for small files: round its numbers and replace "cameras" by fewer "coarse_cameras".

    `psnr` stays as it is, and `psnr_before` says that compression, or an earlier edit, has changed the model since it
    was measured.

    MIN_COARSE_CAMERAS are kept, and more where these show the scene less finely than all of them. Their positions are
    rounded to about scale / COARSE_POSE_STEPS_PER_SCENE_SCALE, which is precise enough to render from there, but not to
    train. Cameras that cannot be read are left out, and a viewpoint that cannot be read stays as it is.

    Args:
        provenance: the provenance of a trained model.
        scale: longest half-axis of the scene's frame, in world units.
        points: (N, 3) the Gaussians' centres in world units; without them, the cameras are evenly spaced.
    """
    replaced = ("cameras", RATE_RATIO_KEY) if "cameras" in provenance else ()
    shortened = {name: value for name, value in provenance.items() if name not in replaced}
    if "psnr" in shortened:
        shortened.setdefault(PSNR_BEFORE_KEY, PSNR_BEFORE_COMPRESSION)
    with suppress(TypeError, ValueError, ArithmeticError, KeyError):
        shortened["viewpoint"] = Viewpoint.from_json(provenance["viewpoint"]).to_json(rounded=True)
    with suppress(TypeError, ValueError, ArithmeticError, KeyError):
        cameras = [camera_from_numbers(numbers) for numbers in provenance["cameras"]]
        cameras, ratio = select_representative_cameras(
            cameras, np.zeros((0, 3)) if points is None else points, scale, MIN_COARSE_CAMERAS, MAX_SAMPLING_CAMERAS
        )
        ratio *= stored_rate_ratio(provenance)
        if ratio > COARSE_RATE_RATIO:
            shortened[RATE_RATIO_KEY] = _rounded_ratio(ratio)
        farthest = max((float(np.linalg.norm(camera.position)) for camera in cameras), default=0.0)
        # Rounding a rotation moves the camera in proportion to its distance from the origin.
        decimals = (
            int(np.clip(np.ceil(np.log10(max(2 * farthest / scale, 1e-9) * COARSE_POSE_STEPS_PER_SCENE_SCALE)), 4, 15)),
            int(np.clip(np.ceil(np.log10(COARSE_POSE_STEPS_PER_SCENE_SCALE / scale)), 0, MAX_COARSE_DECIMALS)),
        )
        shortened["coarse_cameras"] = [camera_to_numbers(camera, decimals) for camera in cameras]
    return shortened


def _rounded_ratio(ratio: float) -> float:
    return min(float(np.ceil(100 * ratio) / 100), MAX_RATE_RATIO)


def has_mean_exposure(provenance: dict) -> bool:
    """Return whether a model was trained to its photos' mean exposure without an exposure map, by an earlier version.

    Renders of such a model also differ from a photo by that photo's own exposure.
    """
    return provenance.get("mean_exposure") is True


@dataclass(frozen=True)
class Capture:
    """The cameras and the viewpoint from which a model was photographed, taken from its file or from a scene.

    Values are read from the provenance only when a property is asked for.

    Attributes:
        facts: the result of `hyrfpack.describe_file`. The caller passes it, because this module cannot import that one.
        scene: the photos of the model, if there are any. It is ignored if it has no training views.
    """

    facts: dict
    scene: Scene | None = None

    @property
    def cameras(self) -> list[Camera]:
        """The cameras of the capture, from the first of these sources that has any.

        The sources are: the scene's training views; the cameras stored in the file; its coarse cameras; an orbit about
        the model's viewpoint.

        Raises:
            HyrfDataError: the provenance is not valid.
        """
        if self._training_cameras:
            return self._training_cameras
        if self.is_synthetic:
            return orbit(self.viewpoint, FALLBACK_ORBIT_CAMERAS)
        try:
            return [camera_from_numbers(numbers) for numbers in self._stored_cameras or self._coarse_cameras]
        except (TypeError, ValueError, ArithmeticError) as error:
            raise HyrfDataError(
                f"the cameras that the file keeps are not valid ({error!s:.160})",
                fix="name the photos with `data`",
            ) from error

    @property
    def is_synthetic(self) -> bool:
        """Return whether `cameras` is a generated orbit, because no camera is known."""
        return not (self._training_cameras or self._stored_cameras or self._coarse_cameras)

    @property
    def is_coarse(self) -> bool:
        """Return whether `cameras` have rounded poses, see `quantized_provenance`."""
        return bool(not (self._training_cameras or self._stored_cameras) and self._coarse_cameras)

    @property
    def viewpoint(self) -> Viewpoint:
        """The viewpoint stored in the file, or one derived from the model's frame if the file has none.

        Raises:
            HyrfDataError: the stored viewpoint or the frame is not valid.
        """
        stored, frame = self.facts["provenance"].get("viewpoint"), self.facts["config"]["frame"]
        try:
            if stored is None:
                return Viewpoint.from_frame(frame["center"], frame["scale"], frame.get("rotation", IDENTITY))
            return Viewpoint.from_json(stored)
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise HyrfDataError(
                f"the model's viewpoint cannot be used ({error})",
                fix="render with `data` or `cameras` instead",
            ) from error

    @property
    def mismatch(self) -> str:
        """The problem if the cameras of the scene differ from those stored in the file, otherwise "".

        They differ if the photos show another scene, or if their poses are in another coordinate frame. Without a
        scene or without stored cameras there is none. Names of photos are not compared: files do not store them,
        and photos keep their names when their poses are estimated again.
        """
        if self.scene is None:
            return ""
        differences = self._differences_of_stored_cameras(self._views)
        matched = int((differences <= 1).sum())
        if matched >= _MIN_MATCHED_CAMERA_SHARE * len(differences):
            return ""
        return (
            f"{self.scene.path}: of the {len(differences)} cameras that the model keeps of its training, "
            f"{matched or 'none'} "
            f"{'are' if matched > 1 else 'is'} among those of these photos, which may show another scene or have poses "
            "in another coordinate frame"
        )

    @property
    def difference(self) -> float:
        """How much the scene's cameras differ from those stored in the file: their median difference.

        1 is the largest difference at which a stored camera matches. Without cameras to compare it is 0.
        """
        differences = self._differences_of_stored_cameras(self._views)
        return float(np.median(differences)) if len(differences) else 0.0

    @property
    def leak(self) -> str:
        """The problem if the model was trained on held-out photos of the scene, as far as stored cameras tell, or "".

        A stored camera is that of a held-out photo if it matches it, and differs from all others clearly more than the
        rounding of coarse cameras explains.
        """
        if self.scene is None or not (self.scene.train and self.scene.test):
            return ""
        held_out, others = map(self._differences_of_stored_cameras, (self.scene.test, self.scene.train))
        leaked = int(((held_out <= 1) & (held_out < others / 2) & (others - held_out > _MIN_LEAK_MARGIN)).sum())
        if not leaked:
            return ""
        return (
            f"{self.scene.path}: of the {len(held_out)} cameras that the model keeps of its training, {leaked} "
            f"{'are' if leaked > 1 else 'is'} among those of the held-out photos, so the model was trained on some of "
            "them, and scores on them are too high"
        )

    @property
    def _views(self) -> list[View]:
        return [] if self.scene is None else self.scene.views

    def _differences_of_stored_cameras(self, views: Sequence[View]) -> np.ndarray:
        """Return how much each stored camera (K,) differs from the most similar one of some views.

        1 is the largest difference in position or direction at which cameras match. K is 0 if none can be compared.
        """
        try:
            stored = [camera_from_numbers(numbers) for numbers in self._stored_cameras or self._coarse_cameras or ()]
            limit = _MAX_MATCH_DISTANCE_SCENE_SCALES * float(self.facts["config"]["frame"]["scale"])
        except (TypeError, ValueError, ArithmeticError, KeyError):
            return np.zeros(0)
        if not (views and stored):
            return np.zeros(0)
        positions = np.array([view.camera.position for view in views])
        directions = np.array([view.camera.forward for view in views])
        differences = []
        for camera in stored:
            distances = np.linalg.norm(positions - camera.position, axis=1) / limit
            angles = np.degrees(np.arccos(np.clip(directions @ camera.forward, -1, 1))) / _MAX_MATCH_ANGLE_DEGREES
            differences.append(np.maximum(distances, angles).min())
        return np.array(differences)

    @property
    def max_size(self) -> int:
        """The `max_size` of `load_scene` at which photos have the size that the model was trained at.

        It is DEFAULT_MAX_SIZE if the file does not state a valid one.
        """
        stored = self.facts["provenance"].get("max_size")
        usable = isinstance(stored, int) and not isinstance(stored, bool) and is_max_size(stored)
        return stored if usable else DEFAULT_MAX_SIZE

    @property
    def _stored_cameras(self) -> Any:
        return self.facts["provenance"].get("cameras")

    @property
    def _coarse_cameras(self) -> Any:
        return self.facts["provenance"].get("coarse_cameras")

    @property
    def _training_cameras(self) -> list[Camera]:
        return [] if self.scene is None else [view.camera for view in self.scene.train]


@overload
def place_photos(facts: dict, scene: Scene) -> Scene: ...
@overload
def place_photos(facts: dict, scene: None) -> None: ...
def place_photos(facts: dict, scene: Scene | None) -> Scene | None:
    """Return photos in the coordinates of a model.

    Edits may have moved the model since it was trained on the photos. Then the photos are moved in the same way, unless
    their cameras already agree better with those that the model keeps.

    Args:
        facts: the result of `hyrfpack.describe_file`.
        scene: photos with the poses of training, or with poses in the coordinates of the model; or None.

    Example:
        >>> import hyrfpack
        >>> from hyrfpack.config.edit import Center
        >>> report = hyrfpack.edit_model("bonsai.hyrf", "centred.hyrf", [Center()])
        >>> scene = hyrfpack.load_scene("photos/bonsai")
        >>> placed = hyrfpack.place_photos(hyrfpack.describe_file("centred.hyrf"), scene)
        >>> len(placed.test) == len(scene.test)
        True
    """
    if scene is None:
        return None
    try:
        moved = Placement.from_json(facts["provenance"][PLACEMENT_KEY]).move_scene(scene)
    except (TypeError, ValueError, ArithmeticError, KeyError):  # never moved, or no valid placement
        return scene
    as_given, as_moved = (Capture(facts, candidate).difference for candidate in (scene, moved))
    return moved if as_moved < as_given else scene

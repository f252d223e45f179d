"""A scene in new world coordinates: p' = factor R p + offset. Only the frame and the stored cameras change."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from hyrfpack.cameras.files import camera_from_numbers, camera_to_numbers
from hyrfpack.cameras.paths import Viewpoint
from hyrfpack.config.edit import Move, Rotate, Scale, Translate
from hyrfpack.errors import HyrfError
from hyrfpack.model import HybridModel
from hyrfpack.model.frame import Frame
from hyrfpack.rotations import IDENTITY, quaternion_from_matrix, rotation_matrix
from hyrfpack.scene import MAX_WORLD_COORDINATE, Camera, View

CAMERA_KEYS = ("cameras", "coarse_cameras")
# A scene whose frame is turned by less has been turned back, and gets the file of one that was never turned.
MIN_TURN_RADIANS = 1e-12
# Poses and centres are float64, which at this multiple of a scene's half size still hold a ten-thousandth of it.
MAX_DISTANCE_RATIO = 1e12
MIN_FRAME_SCALE = 1e-30  # sizes are float32 in files and pictures, see MAX_WORLD_COORDINATE


@dataclass(frozen=True, eq=False)
class Placement:
    """A similarity of world positions, p' = factor R p + offset.

    Attributes:
        factor: scale factor, above 0.
        rotation: (3, 3) float64 proper rotation R.
        offset: (3,) float64.
    """

    factor: float = 1.0
    rotation: np.ndarray = field(default_factory=lambda: np.eye(3))
    offset: np.ndarray = field(default_factory=lambda: np.zeros(3))

    @classmethod
    def translation(cls, offset: Sequence[float] | np.ndarray) -> Placement:
        """Return the map p' = p + offset."""
        return cls(offset=np.asarray(offset, np.float64))

    @classmethod
    def rotation_about_axis(cls, axis: Sequence[float] | np.ndarray, degrees: float) -> Placement:
        """Return the right-handed rotation about an axis (3,) of any length above 0 through the origin."""
        x, y, z = math.sin(math.radians(degrees) / 2) * unit_vector(axis)
        return cls(rotation=rotation_matrix((math.cos(math.radians(degrees) / 2), x, y, z)))

    @classmethod
    def of(cls, move: Move) -> Placement:
        """Return the map of a move.

        Raises:
            TypeError: it is no move.
        """
        if isinstance(move, Translate):
            return cls.translation(move.offset)
        if isinstance(move, Rotate):
            return cls.rotation_about_axis(move.axis, move.degrees)
        if isinstance(move, Scale):
            return cls(move.factor)
        raise TypeError(f"{move!r} is no move; use Translate, Rotate or Scale of hyrfpack.config.edit")

    def then(self, step: Placement) -> Placement:
        """Return the map of this one followed by `step`."""
        return Placement(self.factor * step.factor, step.rotation @ self.rotation, step.move_point(self.offset))

    @property
    def is_identity(self) -> bool:
        return self.factor == 1 and np.array_equal(self.rotation, np.eye(3)) and not self.offset.any()

    def move_point(self, point: Sequence[float] | np.ndarray) -> np.ndarray:
        """Return the new position (3,) of a point (3,)."""
        with np.errstate(over="ignore", invalid="ignore"):  # `move_frame` refuses what overflows
            return self.factor * self.move_direction(point) + self.offset

    def move_direction(self, direction: Sequence[float] | np.ndarray) -> np.ndarray:
        """Return the new direction (3,) of a direction (3,), of the same length."""
        return self.rotation @ np.asarray(direction, np.float64)

    def move_camera(self, camera: Camera) -> Camera:
        """Return the camera that sees the moved scene as `camera` sees the scene."""
        pose = camera.camera_from_world.copy()
        pose[:3, :3] = pose[:3, :3] @ self.rotation.T
        pose[:3, 3] = self.factor * pose[:3, 3] - pose[:3, :3] @ self.offset
        return replace(camera, camera_from_world=pose)

    def move_view(self, view: View) -> View:
        """Return the view of the moved scene that shows the same photo."""
        return replace(view, camera=self.move_camera(view.camera))

    def move_frame(self, frame: Frame) -> Frame:
        """Return the frame of a moved model.

        Raises:
            HyrfError: the moved scene is too far away, too large or too small for the numbers that hold it.
        """
        x, y, z = self.move_point(frame.center).tolist()
        scale = self.factor * frame.scale
        reach = max(abs(x), abs(y), abs(z), scale)
        if not (MIN_FRAME_SCALE <= scale and reach <= MAX_WORLD_COORDINATE):
            raise HyrfError(
                f"moves take the scene's centre to ({x:g}, {y:g}, {z:g}) and its half size to {scale:g}; sizes of at "
                f"least {MIN_FRAME_SCALE:g} and coordinates of at most {MAX_WORLD_COORDINATE:g} are possible",
                fix="move and scale it by less",
            )
        if reach > MAX_DISTANCE_RATIO * scale:
            raise HyrfError(
                f"moves take the scene's centre to ({x:g}, {y:g}, {z:g}), {reach / scale:.2g} times its half size off; "
                f"up to {MAX_DISTANCE_RATIO:g} times, numbers are fine enough to keep its shape",
                fix="move it by less",
            )
        w, i, j, k = (quaternion_from_matrix(self.rotation @ frame.axes) + 0.0).tolist()  # + 0.0 turns -0.0 into 0.0
        rotation = IDENTITY if 2 * math.hypot(i, j, k) < MIN_TURN_RADIANS else (w, i, j, k)
        return Frame((x, y, z), scale, frame.half_extent, rotation)

    def move_model(self, model: HybridModel) -> HybridModel:
        """Return the moved model, which shares all parameters with `model`: only its frame differs."""
        return replace_config(model, frame=self.move_frame(model.config.frame))

    def move_provenance(self, provenance: dict) -> dict:
        """Return a provenance with moved cameras and viewpoint. Entries that cannot be read are left out."""
        moved = dict(provenance)
        for key in (*CAMERA_KEYS, "viewpoint"):
            if key in moved:
                del moved[key]
                with suppress(TypeError, ValueError, ArithmeticError, KeyError):
                    moved[key] = self._move_entry(key, provenance[key])
        return moved

    def _move_entry(self, key: str, entry: Any) -> Any:
        if key in CAMERA_KEYS:
            return [camera_to_numbers(self.move_camera(camera_from_numbers(numbers))) for numbers in entry]
        viewpoint = Viewpoint.from_json(entry)
        return replace(
            viewpoint,
            center=self.move_point(viewpoint.center),
            up=self.move_direction(viewpoint.up),
            camera=self.move_camera(viewpoint.camera),
        ).to_json()


def unit_vector(vector: Sequence[float] | np.ndarray) -> np.ndarray:
    """Scale a vector (3,) of any length above 0 to unit length."""
    scaled = np.asarray(vector, np.float64) / np.abs(vector).max()  # so that no square overflows or becomes 0
    return scaled / np.linalg.norm(scaled)


def replace_config(model: HybridModel, **changes: Any) -> HybridModel:
    """Return a model with changed fields of its configuration; it shares all parameters with `model`."""
    changed = HybridModel(replace(model.config, **changes), model.gaussians)
    changed.geometry, changed.radiance = model.geometry, model.radiance
    changed.copy_settings(model)
    return changed

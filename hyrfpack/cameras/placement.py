"""A scene in new world coordinates: p' = factor R p + offset."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from hyrfpack.cameras.files import round_number
from hyrfpack.rotations import quaternion_from_matrix, rotation_matrix
from hyrfpack.scene import Camera, Scene, View


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

    def move_scene(self, scene: Scene) -> Scene:
        """Return the photos and points of a scene in the coordinates after the move."""
        return replace(
            scene,
            train=[self.move_view(view) for view in scene.train],
            test=[self.move_view(view) for view in scene.test],
            points=self.factor * scene.points @ self.rotation.T + self.offset,
        )

    def to_json(self) -> dict[str, Any]:
        """Return the placement as files store it; `from_json` reads it back."""
        rotation, offset = (
            [round_number(value) + 0.0 for value in numbers]  # + 0.0 turns -0.0 into 0.0
            for numbers in (quaternion_from_matrix(self.rotation), self.offset)
        )
        return {"factor": round_number(self.factor), "rotation": rotation, "offset": offset}

    @classmethod
    def from_json(cls, stored: Any) -> Placement:
        """Read the result of `to_json`.

        Raises:
            KeyError, TypeError, ValueError: `stored` is not a placement.
        """
        factor, offset = float(stored["factor"]), np.array(stored["offset"], np.float64)
        if offset.shape != (3,) or not (np.isfinite(offset).all() and 0 < factor < math.inf):
            raise ValueError("a factor above 0 and three finite coordinates are needed")
        return cls(factor, rotation_matrix(stored["rotation"]), offset)


def unit_vector(vector: Sequence[float] | np.ndarray) -> np.ndarray:
    """Scale a vector (3,) of any length above 0 to unit length."""
    scaled = np.asarray(vector, np.float64) / np.abs(vector).max()  # so that no square overflows or becomes 0
    return scaled / np.linalg.norm(scaled)

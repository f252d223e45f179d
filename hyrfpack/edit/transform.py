"""A scene in new world coordinates: p' = factor p + offset. Only the frame and the stored cameras change."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hyrfpack.cameras.files import camera_from_numbers, camera_to_numbers
from hyrfpack.cameras.paths import Viewpoint
from hyrfpack.model import HybridModel
from hyrfpack.model.frame import Frame
from hyrfpack.scene import Camera, View

CAMERA_KEYS = ("cameras", "coarse_cameras")


@dataclass(frozen=True, eq=False)
class Placement:
    """A map of world positions, p' = factor p + offset.

    Attributes:
        factor: scale factor, above 0.
        offset: (3,) float64.
    """

    factor: float
    offset: np.ndarray

    @classmethod
    def identity(cls) -> Placement:
        return cls(1.0, np.zeros(3))

    def then(self, factor: float, offset: Sequence[float] | np.ndarray) -> Placement:
        """Return the map of this one followed by p' = factor p + offset."""
        return Placement(factor * self.factor, factor * self.offset + np.asarray(offset, np.float64))

    @property
    def is_identity(self) -> bool:
        return self.factor == 1 and not self.offset.any()

    def move_point(self, point: Sequence[float] | np.ndarray) -> np.ndarray:
        """Return the new position (3,) of a point (3,)."""
        return self.factor * np.asarray(point, np.float64) + self.offset

    def move_camera(self, camera: Camera) -> Camera:
        """Return the camera that sees the moved scene as `camera` sees the scene."""
        pose = camera.camera_from_world.copy()
        pose[:3, 3] = self.factor * pose[:3, 3] - pose[:3, :3] @ self.offset
        return replace(camera, camera_from_world=pose)

    def move_view(self, view: View) -> View:
        """Return the view of the moved scene that shows the same photo."""
        return replace(view, camera=self.move_camera(view.camera))

    def move_model(self, model: HybridModel) -> HybridModel:
        """Return the moved model, which shares all parameters with `model`: only its frame differs."""
        frame = model.config.frame
        x, y, z = self.move_point(frame.center).tolist()
        return replace_config(model, frame=Frame((x, y, z), self.factor * frame.scale, frame.half_extent))

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
            viewpoint, center=self.move_point(viewpoint.center), camera=self.move_camera(viewpoint.camera)
        ).to_json()


def replace_config(model: HybridModel, **changes: Any) -> HybridModel:
    """Return a model with changed fields of its configuration; it shares all parameters with `model`."""
    changed = HybridModel(replace(model.config, **changes), model.gaussians)
    changed.geometry, changed.radiance = model.geometry, model.radiance
    changed.copy_settings(model)
    return changed

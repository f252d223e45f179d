"""The scene between two actions of an edit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hyrfpack.edit.transform import Placement
from hyrfpack.model import HybridModel
from hyrfpack.model.merged import MergedModel, map_parts, world_positions
from hyrfpack.progress import Progress, ignore_progress
from hyrfpack.scene import Camera, View


@dataclass(frozen=True, eq=False)
class EditState:
    """A scene in the middle of an edit.

    Attributes:
        model: the model, or all parts of a merged file that have Gaussians.
        cameras: the training cameras, in the model's world coordinates.
        center: (3,) the point that the cameras look at, likewise.
        up: (3,) the up direction.
        photos: the training photos, likewise; empty if they are not given.
        placement: the map from the world coordinates of the file that is edited.
        progress: called with `TaskEvent`s.
        held_out: the held-out photos, likewise.
        has_gains: whether the model was trained with per-image gains, so that photos differ from it in exposure.
        has_scene: whether the first part is the one that the photos show. An edit may leave nothing of that one.
    """

    model: HybridModel | MergedModel
    cameras: list[Camera]
    center: np.ndarray
    up: np.ndarray
    photos: list[View]
    placement: Placement
    progress: Progress = ignore_progress
    held_out: Sequence[View] = ()
    has_gains: bool = False
    has_scene: bool = True

    def move(self, step: Placement) -> EditState:
        """Return the scene in new world coordinates."""
        return replace(
            self,
            model=map_parts(step.move_model, self.model),
            cameras=[step.move_camera(camera) for camera in self.cameras],
            center=step.move_point(self.center),
            up=step.move_direction(self.up),
            photos=[step.move_view(view) for view in self.photos],
            held_out=[step.move_view(view) for view in self.held_out],
            placement=self.placement.then(step),
        )

    def world_positions(self) -> np.ndarray:
        """Return the Gaussians' centres (N, 3) in world units, float64."""
        return world_positions(self.model)

"""Hold the state of a scene between two actions of an edit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from hyrfpack.cameras.capture import Capture
from hyrfpack.cameras.placement import Placement
from hyrfpack.edit.transform import move_model
from hyrfpack.errors import HyrfError
from hyrfpack.model import HybridModel
from hyrfpack.model.merged import MergedModel, map_parts, world_positions
from hyrfpack.progress import Progress, ignore_progress
from hyrfpack.scene import Camera, View


@dataclass(frozen=True, eq=False)
class EditState:
    """A scene in the middle of an edit.

    Attributes:
        source: the file as messages name it.
        captures: cameras and viewpoint of each part of the file before the edit, by name; "" for a file of one model.
        model: the model, or all parts of a merged file that have Gaussians.
        cameras: the training cameras of the first part, in the model's world coordinates.
        center: (3,) the point that the cameras look at, in the model's world coordinates.
        up: (3,) the up direction in the model's world coordinates.
        photos: the training photos, in the model's world coordinates; empty if no photos are given.
        placement: the map from the world coordinates of the file that is edited.
        progress: called with `TaskEvent`s.
        held_out: the held-out photos, in the model's world coordinates.
        has_gains: whether the model was trained with per-image gains, so that photos differ from it in exposure.
        has_scene: whether the first part is the one that the photos show. An edit may remove that part.
        has_chosen_up: whether an action chose `up`, which is then kept if the first part is removed.
    """

    source: Path
    captures: Mapping[str, Capture]
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
    has_chosen_up: bool = False

    @property
    def capture(self) -> Capture:
        """The cameras and the viewpoint of the first part before the edit."""
        return self.captures[self.model.names[0] if isinstance(self.model, MergedModel) else ""]

    def photo_cameras(self, purpose: str) -> list[Camera]:
        """Return the cameras of the photos that show the first part, or those that its file keeps.

        Args:
            purpose: what the cameras are needed for, as the end of the sentence "it keeps no cameras ...".

        Raises:
            HyrfError: there are neither photos nor cameras.
        """
        if self.has_scene and self.photos:
            return [view.camera for view in self.photos]
        if self.capture.is_synthetic:
            raise HyrfError(
                f"{self.source}: this file keeps no cameras {purpose}",
                fix="name the photos with `data`, or give numbers instead",
            )
        return self.cameras

    def move(self, step: Placement) -> EditState:
        """Return the scene in new world coordinates."""
        return replace(
            self,
            model=map_parts(partial(move_model, step), self.model),
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

"""The frame of a scene and its coordinate systems.

Points are mapped through three coordinate systems:

- **world**: the input's own axes, origin and unit (float64);
- **local**: `local = R^T (world - center) / scale`; the scene's box lies within [-1, 1]^3. All learnt positions and
  sizes are local, so that nothing depends on the unit, the origin or the axes of the world, and float32 is precise
  enough. Training leaves R at the identity; an edit that turns a scene changes R alone;
- **cube**: `contract(local / half_extent)` in (0, 1)^3, the domain of the hash grids.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from hyrfpack.errors import HyrfDataError
from hyrfpack.ops.viewport import Viewport
from hyrfpack.rotations import IDENTITY, Quaternion, check_rotation, rotation_matrix
from hyrfpack.scene import Camera

# Flat boxes are widened to this fraction of the longest half-axis, because even a row of cameras sees a volume.
MIN_HALF_EXTENT = 0.25


@dataclass(frozen=True)
class Frame:
    """The box B0 of a scene, which defines its local coordinates.

    Attributes:
        center: centre (x, y, z) of the box in world units.
        scale: world units per local unit, which is the longest half-axis of the box; positive.
        half_extent: half-axes of the box in local units, each in [MIN_HALF_EXTENT, 1].
        rotation: rotation R from local to world axes, a quaternion wxyz of unit length.

    Raises:
        ValueError: the quaternion has no unit length.
    """

    center: tuple[float, float, float]
    scale: float
    half_extent: tuple[float, float, float]
    rotation: Quaternion = IDENTITY

    def __post_init__(self) -> None:
        check_rotation(self.rotation)

    @property
    def axes(self) -> np.ndarray:
        """Return R (3, 3) float64, whose columns are the local axes in the world."""
        return rotation_matrix(self.rotation)

    @property
    def is_rotated(self) -> bool:
        """Return whether the local axes differ from those of the world."""
        return self.rotation != IDENTITY

    @classmethod
    def from_box(cls, low: np.ndarray, high: np.ndarray) -> Frame:
        """Build the frame of the box between two corners (3,) in world units; flat axes are widened.

        Raises:
            HyrfDataError: a corner is not finite, or the box has size 0.
        """
        low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
        half = high / 2 - low / 2
        scale = float(half.max())
        if not (np.isfinite(low).all() and np.isfinite(high).all()):
            raise HyrfDataError("the scene's box is not finite", fix="check the poses and points for NaN or infinity")
        if not scale > 0:
            raise HyrfDataError(
                "cameras and points all lie at one place, so the scene has no size",
                fix="give views from different places",
            )
        half = np.maximum(half / scale, MIN_HALF_EXTENT)
        (x, y, z), (a, b, c) = (low / 2 + high / 2).tolist(), half.tolist()
        return cls((x, y, z), scale, (a, b, c))

    def to_local(self, points: np.ndarray) -> np.ndarray:
        """Convert world positions (N, 3) to local positions, float64."""
        return (np.asarray(points, np.float64) - np.array(self.center)) / self.scale @ self.axes

    def to_world(self, points: np.ndarray) -> np.ndarray:
        """Convert local positions (N, 3) to world positions, float64."""
        return np.asarray(points, np.float64) * self.scale @ self.axes.T + np.array(self.center)

    def local_pose(self, camera: Camera) -> np.ndarray:
        """Return the camera's pose camera_from_local (4, 4) float64, with depths in local units.

        The pose is computed in float64, so that a scene a million units away from the origin loses no precision.
        """
        pose = camera.camera_from_world.copy()
        pose[:3, 3] = (pose[:3, :3] @ np.array(self.center) + pose[:3, 3]) / self.scale
        pose[:3, :3] = pose[:3, :3] @ self.axes
        return pose

    def local_viewport(self, camera: Camera, dtype: torch.dtype = torch.float32) -> Viewport:
        """Return the camera in local units, with its pose in `dtype` on the CPU."""
        pose = torch.as_tensor(self.local_pose(camera), dtype=dtype)
        return Viewport(pose, camera.intrinsics, camera.width, camera.height)

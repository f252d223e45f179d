"""Viewpoints and camera paths for renders without photos: an orbit around what the training cameras looked at."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any

import numpy as np

from hyrfpack.cameras.files import INTRINSICS_KEYS, camera_from_json, check_json_numbers, round_number, round_pose
from hyrfpack.cameras.placement import unit_vector
from hyrfpack.rotations import IDENTITY, rotation_matrix
from hyrfpack.scene import Camera

# Cameras that cover at least this much azimuth are treated as a full circle.
MIN_FULL_CIRCLE_DEGREES = 270.0
# Cameras count as held level up to this mean squared sine of their roll.
MAX_LEVEL_ROLL_MEAN_SQUARE = 0.05
# The up axis of level cameras is known only if the mean squared sine of their headings is at least this.
MIN_HEADING_MEAN_SQUARE = 0.02
# A scene photographed from nearly one direction gets an arc at least this wide.
MIN_ARC_DEGREES = 20.0
# Cameras have a common direction if the mean of their unit viewing directions is at least this long.
MIN_COMMON_DIRECTION_LENGTH = 0.9
# Of cameras that look down, pictures are rotated against each other: the mean of their down axes is at most this long.
MAX_ROTATED_DOWN_LENGTH = 0.5
# Cameras lie in a plane if they spread across it by at most this share of their smaller spread along it.
MAX_PLANE_THICKNESS_RATIO = 0.25
MIN_PLANE_CAMERAS = 6
MIN_PLANE_AGREEMENT = math.cos(math.radians(20))  # with the direction opposite to the views


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """The centre of a scene, its up direction, and a typical camera that looks at it.

    Two viewpoints are never equal unless they are the same object; compare the results of `to_json` instead.

    Attributes:
        center: (3,) float64, the point that cameras look at, in world units.
        up: (3,) float64, the up direction; any length above zero.
        camera: the typical camera.
        arc: the first and the last azimuth that photos cover, in degrees about `up` and relative to that camera;
            (0, 360) if they cover the full circle.
    """

    center: np.ndarray
    up: np.ndarray
    camera: Camera
    arc: tuple[float, float]

    def validated(self) -> Viewpoint:
        """Check this viewpoint and return it.

        Raises:
            ValueError: a number is not finite or too large for cameras around the centre, or `up` is (0, 0, 0).
        """
        others = *self.camera.position, self.camera.cx, self.camera.cy, *self.arc
        # The limit keeps cameras around the centre finite in float32.
        if self.center.shape != (3,) or not (np.abs([*self.center, *others]) < 1e37).all():
            raise ValueError("a number is missing or not finite")
        if self.up.shape != (3,) or not 0 < np.linalg.norm(self.up) < np.inf:
            raise ValueError("'up' is not a direction")
        return self

    @classmethod
    def from_cameras(cls, cameras: Sequence[Camera]) -> Viewpoint:
        """Summarise a capture of at least one camera.

        - `center`: the point nearest to all viewing axes (least squares). It is a point in front of the typical camera
          if the axes are nearly parallel, as on a drive, or point away from it, as in a room seen from its middle.
        - `up`, of unit length: the direction perpendicular to the cameras' right axes (least squares). If it is
          ambiguous (all cameras look in one direction, or many are rolled), it is the mean of their up axes, or the
          typical camera's own.
        - `camera`: the camera nearest to the capture's median distance and height.
        """
        positions = np.array([camera.position for camera in cameras])
        forwards = np.array([camera.forward for camera in cameras])
        up = _up_axis(np.array([camera.rotation for camera in cameras]))
        center = _common_focus(positions, forwards)
        if center is not None:
            offsets = positions - center
            heights = offsets @ up
            radii = np.linalg.norm(offsets - np.outer(heights, up), axis=1)
            typical = _nearest_to_median(np.stack((radii, heights), axis=1))
            arc = _covered_arc(offsets, up, typical)
        else:
            typical = _nearest_to_median(positions)
            spread = float(np.median(np.linalg.norm(positions - positions[typical], axis=1)))
            center = positions[typical] + forwards[typical] * (2 * spread or 1.0)
            up = -cameras[typical].rotation[1]  # makes the arc horizontal in this camera's picture
            arc = -MIN_ARC_DEGREES / 2, MIN_ARC_DEGREES / 2
        return cls(center, up, cameras[typical], arc)

    @classmethod
    def from_frame(cls, center: Sequence[float], scale: float, rotation: Sequence[float] = IDENTITY) -> Viewpoint:
        """Derive a viewpoint from a model's frame, for a model whose file does not store one.

        The camera looks slightly down at the frame's centre, from a distance of 2.5 times its longest half-axis. Its
        picture is 800 x 600 with a horizontal field of view of 50 degrees. Up is the frame's -y axis, as in most
        reconstructions.

        Args:
            center, scale, rotation: of the frame; the rotation is a quaternion wxyz.

        Raises:
            ValueError: a number is not finite, or the quaternion has no unit length.
        """
        axes, middle = rotation_matrix(rotation), np.asarray(center, np.float64)
        up = axes @ (0.0, -1.0, 0.0)
        position = middle + 2.5 * scale * axes @ (0.0, -math.sin(math.radians(20)), -math.cos(math.radians(20)))
        focal = 400 / math.tan(math.radians(25))
        camera = Camera(800, 600, focal, focal, 400.0, 300.0, look_at(position, middle, up))
        return cls(middle, up, camera, (0.0, 360.0)).validated()

    def to_json(self, rounded: bool = False) -> dict[str, Any]:
        """Convert to a dictionary ready for JSON, the "viewpoint" of a file's provenance.

        Args:
            rounded: round the pose by `round_pose`, and all other numbers by `round_number`.
        """
        numbers = {
            "center": self.center.tolist(),
            "up": self.up.tolist(),
            "camera_from_world": self.camera.camera_from_world.tolist(),
            "intrinsics": list(self.camera.intrinsics),
            "width": self.camera.width,
            "height": self.camera.height,
            "arc": list(self.arc),
        }
        if not rounded:
            return numbers
        return {**_round_numbers(numbers), "camera_from_world": round_pose(numbers["camera_from_world"])}

    @classmethod
    def from_json(cls, stored: Mapping[str, Any]) -> Viewpoint:
        """Convert an untrusted dictionary of the layout that `to_json` writes to a viewpoint.

        Raises:
            KeyError: a key is missing.
            TypeError, ValueError, OverflowError: a value is not valid.
        """
        rows, lists = stored["camera_from_world"], (stored[key] for key in ("center", "up", "intrinsics", "arc"))
        check_json_numbers((stored["width"], stored["height"], *chain(*rows, *lists)))
        center, up = np.array(stored["center"], np.float64), np.array(stored["up"], np.float64)
        camera = camera_from_json({**stored, **dict(zip(INTRINSICS_KEYS[2:], stored["intrinsics"], strict=True))})
        first, last = (float(value) for value in stored["arc"])
        return cls(center, up, camera, (first, last)).validated()


def common_direction(cameras: Sequence[Camera]) -> np.ndarray | None:
    """Return the (3,) unit direction that all cameras look in, or None if they look in different directions."""
    mean = np.mean([camera.forward for camera in cameras], axis=0)
    length = np.linalg.norm(mean)
    return mean / length if length >= MIN_COMMON_DIRECTION_LENGTH else None


def downward_direction(cameras: Sequence[Camera]) -> np.ndarray | None:
    """Return the (3,) unit direction that cameras of a flight look in, straight down, or None for other cameras.

    They share a viewing direction while their pictures are rotated against each other.
    """
    mean_down = np.mean([camera.rotation[1] for camera in cameras], axis=0)
    return None if np.linalg.norm(mean_down) >= MAX_ROTATED_DOWN_LENGTH else common_direction(cameras)


def estimate_up(cameras: Sequence[Camera]) -> tuple[np.ndarray, str]:
    """Estimate the (3,) unit up direction from at least one camera, and say from what.

    - People hold cameras level, so up is perpendicular to the cameras' right axes, if these determine it.
    - Cameras that look straight down say where up is only roughly, because their mounts are tilted. If they fly at one
      height, up is perpendicular to the plane of their positions, otherwise opposite to their views.
    - Of other cameras, up is the mean of their up axes. A tilt that they all have remains in it.
    """
    if (down := downward_direction(cameras)) is not None:
        normal = _plane_normal(np.array([camera.position for camera in cameras]))
        if normal is not None and abs(normal @ down) >= MIN_PLANE_AGREEMENT:
            return -np.sign(normal @ down) * normal, "the plane in which the cameras fly"
        return -down, "the direction opposite to the cameras' views"
    rotations = np.array([camera.rotation for camera in cameras])
    level = _level_axis(rotations)
    return (_mean_up(rotations), "the mean of the cameras' up axes") if level is None else (level, "the level cameras")


def _plane_normal(points: np.ndarray) -> np.ndarray | None:
    """Return the (3,) unit normal of the plane in which points (N, 3) lie, None if they lie in none."""
    if len(points) < MIN_PLANE_CAMERAS:
        return None
    values, vectors = np.linalg.eigh(np.cov(points.T))
    return vectors[:, 0] if values[0] <= MAX_PLANE_THICKNESS_RATIO**2 * values[1] else None


def orbit(viewpoint: Viewpoint, frames: int) -> list[Camera]:
    """Generate cameras on a circle around a scene, all looking at its centre.

    The circle has the typical camera's distance and height. If the photos do not cover the full circle, the camera
    swings to and fro over the arc that they cover. The path is closed in both cases: the first frame follows the last.

    Args:
        viewpoint: the centre, the up direction, the typical camera and the arc.
        frames: number of cameras; at least 1.
    """
    center, up, camera = viewpoint.center, viewpoint.up / np.linalg.norm(viewpoint.up), viewpoint.camera
    first, last = viewpoint.arc
    offset = camera.position - center
    radius = np.linalg.norm(offset - (offset @ up) * up)
    if not radius > 1e-9 * np.linalg.norm(offset):  # straight above the centre, where the circle would be a point
        offset = offset + 0.5 * (float(np.linalg.norm(offset)) or 1.0) * _perpendicular(up)
    turns = np.arange(frames) / frames
    if last - first >= 360:
        angles = first + (last - first) * turns
    else:
        angles = (first + last) / 2 + (last - first) / 2 * np.sin(2 * math.pi * turns)
    return [
        replace(camera, camera_from_world=look_at(center + _rotate(offset, up, math.radians(angle)), center, up))
        for angle in angles
    ]


def look_at(position: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Return the (4, 4) camera_from_world of a camera at `position` that looks at `target`; `up` is a unit vector."""
    offset = target - position  # of any length: the world's unit may be a millimetre or a light year
    forward = unit_vector(offset) if offset.any() else np.array([0.0, 0.0, 1.0])
    right = np.cross(forward, up)
    right = _unit(right, _perpendicular(forward)) if np.linalg.norm(right) > 1e-9 else _perpendicular(forward)
    pose = np.eye(4)
    pose[:3, :3] = right, np.cross(forward, right), forward
    pose[:3, 3] = -pose[:3, :3] @ position
    return pose


def _up_axis(rotations: np.ndarray) -> np.ndarray:
    """Estimate the (3,) unit up direction from (N, 3, 3) camera rotations."""
    level = _level_axis(rotations)
    return _mean_up(rotations) if level is None else level


def _mean_up(rotations: np.ndarray) -> np.ndarray:
    """Return the (3,) unit mean of the up axes of (N, 3, 3) camera rotations."""
    return _unit(-rotations[:, 1].sum(axis=0), np.array([0.0, -1.0, 0.0]))


def _level_axis(rotations: np.ndarray) -> np.ndarray | None:
    """Return the (3,) unit up direction of level cameras, None if (N, 3, 3) rotations do not determine it."""
    rights, forwards = rotations[:, 0], rotations[:, 2]
    # People hold cameras level, so the cameras' right axes lie in a plane, and up is perpendicular to it.
    values, vectors = np.linalg.eigh(rights.T @ rights / len(rights))
    if values[0] > MAX_LEVEL_ROLL_MEAN_SQUARE or values[1] < max(MIN_HEADING_MEAN_SQUARE, 4 * values[0]):
        return None
    level = vectors[:, 0]
    along = level @ _mean_up(rotations)
    if abs(along) < 0.2:  # the cameras look straight down, so up points from the scene to them
        along = -level @ forwards.mean(axis=0)
    return level if along > 0 else -level


def _common_focus(positions: np.ndarray, forwards: np.ndarray) -> np.ndarray | None:
    """Find the point with the least squared distance to all viewing axes, None if the cameras share no such focus.

    They share none if their axes are nearly parallel or if the point lies behind more than a quarter of them.
    """
    projectors = np.eye(3) - forwards[:, :, None] * forwards[:, None, :]
    normal = projectors.mean(axis=0)
    # The smallest eigenvalue is about the mean squared sine between the axes and their mean direction.
    if np.linalg.eigvalsh(normal)[0] < math.sin(math.radians(4)) ** 2:
        return None
    center = np.linalg.solve(normal, np.mean(projectors @ positions[:, :, None], axis=0)[:, 0])
    in_front = np.einsum("ij,ij->i", center - positions, forwards) > 0
    return center if in_front.mean() > 0.75 else None


def _covered_arc(offsets: np.ndarray, up: np.ndarray, typical: int) -> tuple[float, float]:
    """Return the first and last azimuth that cameras cover, in degrees relative to the typical camera.

    The arc is the full circle without the widest gap between neighbouring cameras.
    """
    axis = _perpendicular(up)
    side = np.cross(up, axis)
    azimuths = np.degrees(np.arctan2(offsets @ side, offsets @ axis))
    relative = np.sort((azimuths - azimuths[typical] + 180) % 360 - 180)
    gaps = np.diff(relative, append=relative[0] + 360)
    widest = int(np.argmax(gaps))
    if 360 - gaps[widest] >= MIN_FULL_CIRCLE_DEGREES:
        return 0.0, 360.0
    first, last = float(relative[(widest + 1) % len(relative)]), float(relative[widest])
    if first > 0:  # the arc must contain the typical camera, which is at 0
        first -= 360
    if last < 0:
        last += 360
    margin = max(0.0, MIN_ARC_DEGREES - (last - first)) / 2
    return first - margin, last + margin


def _nearest_to_median(rows: np.ndarray) -> int:
    """Return the index of the row nearest to the median row."""
    return int(np.argmin(np.linalg.norm(rows - np.median(rows, axis=0), axis=1)))


def _unit(vector: np.ndarray, fallback: np.ndarray) -> np.ndarray:
    """Scale a vector to unit length; return `fallback` if it is shorter than 1e-12."""
    length = np.linalg.norm(vector)
    return vector / length if length > 1e-12 else fallback


def _perpendicular(axis: np.ndarray) -> np.ndarray:
    """Return a unit vector perpendicular to a unit vector."""
    return _unit(np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))]), axis)


def _rotate(vector: np.ndarray, axis: np.ndarray, angle: float) -> np.ndarray:
    """Rotate a vector about a unit axis by an angle in radians (Rodrigues' formula)."""
    cosine, sine = math.cos(angle), math.sin(angle)
    return vector * cosine + np.cross(axis, vector) * sine + axis * (axis @ vector) * (1 - cosine)


def _round_numbers(value: Any) -> Any:
    """Round every number of nested dictionaries and lists by `round_number`."""
    if isinstance(value, dict):
        return {name: _round_numbers(item) for name, item in value.items()}
    if isinstance(value, list):
        return [_round_numbers(item) for item in value]
    return round_number(value) if isinstance(value, float) else value

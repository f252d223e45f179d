"""Where to render from when there are no photos: an orbit around what the training cameras looked at."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hyrfpack.cameras.files import LENS, camera_from_json, rounded_number
from hyrfpack.scene import Camera

WHOLE_CIRCLE = 270.0  # degrees of azimuth; cameras that cover more are taken to stand all around
LEVEL_RIGHTS = 0.05  # mean squared sine of the cameras' roll up to which they count as held level
SPREAD_RIGHTS = 0.02  # and of their heading, from which on that tells which way is up
NARROWEST_SWING = 20.0  # degrees of an orbit about a scene photographed from nearly one direction
SAME_WAY = 0.9  # length of the mean viewing direction from which cameras count as looking the same way


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """What is looked at, and from where. Equal to itself alone: compare what `to_json` gives.

    Attributes:
        center: (3,) float64, what is looked at, world units.
        up: (3,) float64, which way is up; any length but none.
        camera: the typical camera.
        arc: the first and the last degree of azimuth about `up`, relative to that camera, that photos cover; (0, 360)
            when they go all around.
    """

    center: np.ndarray
    up: np.ndarray
    camera: Camera
    arc: tuple[float, float]

    def checked(self) -> Viewpoint:
        """Itself. Raises ValueError: a number is not finite or too large for cameras about it, or `up` is (0, 0, 0)."""
        others = *self.camera.position, self.camera.cx, self.camera.cy, *self.arc
        # Cameras about it shall be finite in float32.
        if self.center.shape != (3,) or not (np.abs([*self.center, *others]) < 1e37).all():
            raise ValueError("a number is missing or not finite")
        if self.up.shape != (3,) or not 0 < np.linalg.norm(self.up) < np.inf:
            raise ValueError("'up' is not a direction")
        return self

    @classmethod
    def of(cls, cameras: Sequence[Camera]) -> Viewpoint:
        """Sum up a capture, of at least one camera.

        - `center`: the point nearest to all viewing axes (least squares). Where the axes are nearly parallel or
          point away from it, as on a drive or in a room seen from its middle, a point in front of the typical camera.
        - `up`, of unit length: the axis that the pictures' rows are level about, or where that is open (all look the
          same way, or many are turned) the mean of the cameras' up axes, or the typical camera's own.
        - `camera`: the one that stands nearest to the capture's median distance and height.
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
            arc = _arc(offsets, up, typical)
        else:
            typical = _nearest_to_median(positions)
            spread = float(np.median(np.linalg.norm(positions - positions[typical], axis=1)))
            center = positions[typical] + forwards[typical] * (2 * spread or 1.0)
            up = -cameras[typical].rotation[1]  # swings sideways, whatever the camera looks at
            arc = -NARROWEST_SWING / 2, NARROWEST_SWING / 2
        return cls(center, up, cameras[typical], arc)

    @classmethod
    def of_frame(cls, center: Sequence[float], scale: float) -> Viewpoint:
        """A viewpoint for a model that does not say how it was photographed.

        Looks slightly down at the frame's centre from 2.5 times its longest half-axis away, 800 x 600 with 50 degrees
        across; up is -y, as in most reconstructions.
        """
        middle, up = np.asarray(center, np.float64), np.array([0.0, -1.0, 0.0])
        position = middle + 2.5 * scale * np.array([0.0, -math.sin(math.radians(20)), -math.cos(math.radians(20))])
        focal = 400 / math.tan(math.radians(25))
        camera = Camera(800, 600, focal, focal, 400.0, 300.0, look_at(position, middle, up))
        return cls(middle, up, camera, (0.0, 360.0)).checked()

    def to_json(self, rounded: bool = False) -> dict[str, Any]:
        """A dictionary ready for JSON: the "viewpoint" of a file's provenance; `rounded`, by `rounded_number`."""
        numbers = {
            "center": self.center.tolist(),
            "up": self.up.tolist(),
            "camera_from_world": self.camera.camera_from_world.tolist(),
            "intrinsics": list(self.camera.intrinsics),
            "width": self.camera.width,
            "height": self.camera.height,
            "arc": list(self.arc),
        }
        return _rounded(numbers) if rounded else numbers

    @classmethod
    def from_json(cls, stored: Mapping[str, Any]) -> Viewpoint:
        """The inverse of `to_json`, for what anyone may have written.

        Raises:
            KeyError, TypeError, ValueError, OverflowError: it is incomplete or makes no sense.
        """
        center, up = np.array(stored["center"], np.float64), np.array(stored["up"], np.float64)
        camera = camera_from_json({**stored, **dict(zip(LENS[2:], stored["intrinsics"], strict=True))})
        first, last = (float(value) for value in stored["arc"])
        return cls(center, up, camera, (first, last)).checked()


def common_direction(cameras: Sequence[Camera]) -> np.ndarray | None:
    """The direction (3,) that cameras look in, unit length, or None where they look different ways."""
    mean = np.mean([camera.forward for camera in cameras], axis=0)
    agreement = np.linalg.norm(mean)
    return mean / agreement if agreement >= SAME_WAY else None


def orbit(viewpoint: Viewpoint, frames: int) -> list[Camera]:
    """Cameras on a circle about a scene, all looking at its centre.

    The circle keeps the typical camera's distance and height. Where the photos do not stand all around, the camera
    swings to and fro over the arc that they cover. Either way the path closes: the frame after the last is the first.

    Args:
        viewpoint: what to go about, and from where.
        frames: how many cameras; at least 1.
    """
    center, up, camera = viewpoint.center, viewpoint.up / np.linalg.norm(viewpoint.up), viewpoint.camera
    first, last = viewpoint.arc
    offset = camera.position - center
    radius = np.linalg.norm(offset - (offset @ up) * up)
    if not radius > 1e-9 * np.linalg.norm(offset):  # straight above: the circle would be a point
        offset = offset + 0.5 * max(float(np.linalg.norm(offset)), 1e-6) * _perpendicular(up)
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
    """camera_from_world (4, 4) of a camera at `position` that looks at `target` with `up` (unit) upwards."""
    forward = _unit(target - position, np.array([0.0, 0.0, 1.0]))
    right = np.cross(forward, up)
    right = _unit(right, _perpendicular(forward)) if np.linalg.norm(right) > 1e-9 else _perpendicular(forward)
    pose = np.eye(4)
    pose[:3, :3] = right, np.cross(forward, right), forward
    pose[:3, 3] = -pose[:3, :3] @ position
    return pose


def _up_axis(rotations: np.ndarray) -> np.ndarray:
    """Which way is up, from (N, 3, 3) camera rotations."""
    rights, downs, forwards = rotations[:, 0], rotations[:, 1], rotations[:, 2]
    mean_up = _unit(-downs.sum(axis=0), np.array([0.0, -1.0, 0.0]))
    # People hold cameras level: the cameras' right axes lie in a plane, and up is at right angles to it.
    values, vectors = np.linalg.eigh(rights.T @ rights / len(rights))
    if values[0] > LEVEL_RIGHTS or values[1] < max(SPREAD_RIGHTS, 4 * values[0]):
        return mean_up
    level = vectors[:, 0]
    along = level @ mean_up
    if abs(along) < 0.2:  # looking straight down: up is where the cameras are
        along = -level @ forwards.mean(axis=0)
    return level if along > 0 else -level


def _common_focus(positions: np.ndarray, forwards: np.ndarray) -> np.ndarray | None:
    """The point with the least squared distance to all viewing axes, None where there is no such place to look at."""
    projectors = np.eye(3) - forwards[:, :, None] * forwards[:, None, :]
    normal = projectors.mean(axis=0)
    # The smallest eigenvalue is about the mean squared sine between the axes and their mean direction.
    if np.linalg.eigvalsh(normal)[0] < math.sin(math.radians(4)) ** 2:
        return None
    center = np.linalg.solve(normal, np.mean(projectors @ positions[:, :, None], axis=0)[:, 0])
    in_front = np.einsum("ij,ij->i", center - positions, forwards) > 0
    return center if in_front.mean() > 0.75 else None


def _arc(offsets: np.ndarray, up: np.ndarray, typical: int) -> tuple[float, float]:
    """Degrees of azimuth that the cameras cover, relative to the typical one: all but the widest gap between two."""
    axis = _perpendicular(up)
    side = np.cross(up, axis)
    azimuths = np.degrees(np.arctan2(offsets @ side, offsets @ axis))
    relative = np.sort((azimuths - azimuths[typical] + 180) % 360 - 180)
    gaps = np.diff(relative, append=relative[0] + 360)
    widest = int(np.argmax(gaps))
    if 360 - gaps[widest] >= WHOLE_CIRCLE:
        return 0.0, 360.0
    first, last = float(relative[(widest + 1) % len(relative)]), float(relative[widest])
    if first > 0:  # the typical camera, at 0, lies on the arc
        first -= 360
    if last < 0:
        last += 360
    short = max(0.0, NARROWEST_SWING - (last - first)) / 2
    return first - short, last + short


def _nearest_to_median(rows: np.ndarray) -> int:
    return int(np.argmin(np.linalg.norm(rows - np.median(rows, axis=0), axis=1)))


def _unit(vector: np.ndarray, otherwise: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vector)
    return vector / length if length > 1e-12 else otherwise


def _perpendicular(axis: np.ndarray) -> np.ndarray:
    """A unit vector at right angles to a unit vector."""
    return _unit(np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))]), axis)


def _rotate(vector: np.ndarray, axis: np.ndarray, angle: float) -> np.ndarray:
    """Rodrigues' rotation about a unit axis, angle in radians."""
    cosine, sine = math.cos(angle), math.sin(angle)
    return vector * cosine + np.cross(axis, vector) * sine + axis * (axis @ vector) * (1 - cosine)


def _rounded(value: Any) -> Any:
    """Every number of nested dictionaries and lists by `rounded_number`."""
    if isinstance(value, dict):
        return {name: _rounded(item) for name, item in value.items()}
    if isinstance(value, list):
        return [_rounded(item) for item in value]
    return rounded_number(value) if isinstance(value, float) else value

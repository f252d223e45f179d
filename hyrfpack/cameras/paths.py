"""Where to render from when there are no photos: an orbit around what the training cameras looked at."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from hyrfpack.cameras.files import focal_length, side_length
from hyrfpack.errors import HyrfDataError
from hyrfpack.scene import Camera, rigid_pose

WHOLE_CIRCLE = 270.0  # degrees of azimuth; cameras that cover more are taken to stand all around
LEVEL_RIGHTS = 0.05  # mean squared sine of the cameras' roll up to which they count as held level
SPREAD_RIGHTS = 0.02  # and of their heading, from which on that tells which way is up
NARROWEST_SWING = 20.0  # degrees of an orbit about a scene photographed from nearly one direction


def viewpoint_hint(cameras: Sequence[Camera]) -> dict:
    """Sum up a capture so that a model alone can be orbited: what it looks at, which way is up, from how far.

    - `center` (3,): the point nearest to all viewing axes (least squares). Where the axes are nearly parallel or
      point away from it, as on a drive or in a room seen from its middle, a point in front of the typical camera.
    - `up` (3,): unit length; the axis that the pictures' rows are level about, or where that is open (all look the
      same way, or many are turned) the mean of the cameras' up axes, or the typical camera's own.
    - `camera_from_world` (4, 4), `intrinsics` [fx, fy, cx, cy], `width`, `height`: the typical camera, the one that
      stands nearest to the capture's median distance and height.
    - `arc` [first, last]: degrees of azimuth about `up`, relative to that camera, that the capture covers;
      [0, 360] when it goes all around.

    Args:
        cameras: the training cameras, world units; at least one.

    Returns:
        A dictionary ready for JSON, for `orbit`.
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
        arc = [-NARROWEST_SWING / 2, NARROWEST_SWING / 2]
    camera = cameras[typical]
    return {
        "center": center.tolist(),
        "up": up.tolist(),
        "camera_from_world": camera.camera_from_world.tolist(),
        "intrinsics": list(camera.intrinsics),
        "width": camera.width,
        "height": camera.height,
        "arc": arc,
    }


def stored_viewpoint(facts: dict) -> dict:
    """The viewpoint in a file's provenance, or one that follows from its frame alone.

    Args:
        facts: from `hyrfpack.describe`.
    """
    viewpoint = facts["provenance"].get("viewpoint")
    if viewpoint is not None:
        return viewpoint
    frame = facts["config"]["frame"]
    return frame_viewpoint(frame["center"], frame["scale"])


def frame_viewpoint(center: Sequence[float], scale: float) -> dict:
    """A viewpoint for a model that does not say how it was photographed.

    Looks slightly down at the frame's centre from 2.5 times its longest half-axis away, 800 x 600 with 50 degrees
    across; up is -y, as in most reconstructions.
    """
    center, up = np.asarray(center, np.float64), np.array([0.0, -1.0, 0.0])
    position = center + 2.5 * scale * np.array([0.0, -math.sin(math.radians(20)), -math.cos(math.radians(20))])
    focal = 400 / math.tan(math.radians(25))
    return {
        "center": center.tolist(),
        "up": up.tolist(),
        "camera_from_world": look_at(position, center, up).tolist(),
        "intrinsics": [focal, focal, 400.0, 300.0],
        "width": 800,
        "height": 600,
        "arc": [0.0, 360.0],
    }


def orbit(viewpoint: dict, frames: int) -> list[Camera]:
    """Cameras on a circle about a scene, all looking at its centre.

    The circle keeps the typical camera's distance and height. Where the photos do not stand all around, the camera
    swings to and fro over the arc that they cover. Either way the path closes: the frame after the last is the first.

    Args:
        viewpoint: from `viewpoint_hint` or `frame_viewpoint`.
        frames: how many cameras; at least 1.

    Raises:
        HyrfDataError: the viewpoint is incomplete or makes no sense.
    """
    try:
        center, up = np.array(viewpoint["center"], np.float64), np.array(viewpoint["up"], np.float64)
        pose = rigid_pose(viewpoint["camera_from_world"])
        fx, fy, cx, cy = (float(value) for value in viewpoint["intrinsics"])
        fx, fy = focal_length(fx), focal_length(fy)
        width, height = side_length(viewpoint["width"]), side_length(viewpoint["height"])
        first, last = (float(value) for value in viewpoint["arc"])
        # The squares of larger numbers overflow.
        if center.shape != (3,) or not (np.abs([*center, *pose.flat, cx, cy, first, last]) < 1e150).all():
            raise ValueError("a number is missing or not finite")
        if up.shape != (3,) or not 0 < np.linalg.norm(up) < np.inf:
            raise ValueError("'up' is no direction")
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise HyrfDataError(
            f"the model's viewpoint cannot be used ({error}); render with --data or --cameras instead"
        ) from error
    up = up / np.linalg.norm(up)
    offset = -pose[:3, :3].T @ pose[:3, 3] - center
    radius = np.linalg.norm(offset - (offset @ up) * up)
    if not radius > 1e-9 * np.linalg.norm(offset):  # straight above: the circle would be a point
        offset = offset + 0.5 * max(np.linalg.norm(offset), 1e-6) * _perpendicular(up)
    turns = np.arange(frames) / frames
    if last - first >= 360:
        angles = first + (last - first) * turns
    else:
        angles = (first + last) / 2 + (last - first) / 2 * np.sin(2 * math.pi * turns)
    return [
        Camera(width, height, fx, fy, cx, cy, look_at(center + _rotate(offset, up, math.radians(angle)), center, up))
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


def _arc(offsets: np.ndarray, up: np.ndarray, typical: int) -> list[float]:
    """Degrees of azimuth that the cameras cover, relative to the typical one: all but the widest gap between two."""
    axis = _perpendicular(up)
    side = np.cross(up, axis)
    azimuths = np.degrees(np.arctan2(offsets @ side, offsets @ axis))
    relative = np.sort((azimuths - azimuths[typical] + 180) % 360 - 180)
    gaps = np.diff(relative, append=relative[0] + 360)
    widest = int(np.argmax(gaps))
    if 360 - gaps[widest] >= WHOLE_CIRCLE:
        return [0.0, 360.0]
    first, last = float(relative[(widest + 1) % len(relative)]), float(relative[widest])
    if first > 0:  # the typical camera, at 0, lies on the arc
        first -= 360
    if last < 0:
        last += 360
    short = max(0.0, NARROWEST_SWING - (last - first)) / 2
    return [first - short, last + short]


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

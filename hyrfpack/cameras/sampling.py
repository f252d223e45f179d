"""How finely photos sampled a scene: the size of their pixels at a point, and cameras that represent it."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import cast

import numpy as np

from hyrfpack.cameras.files import camera_from_numbers
from hyrfpack.scene import Camera, evenly_spaced

# A camera sees points within its picture, enlarged by this share of its size on each side.
PICTURE_MARGIN_RATIO = 0.15
# Coarse cameras are only some of the cameras, so they underestimate the sampling rate of all photos.
COARSE_RATE_RATIO = 1.1
RATE_RATIO_KEY = "rate_ratio"
MAX_RATE_RATIO = 1000.0
# Cameras represent all photos if this share of the points has at least 1 / MAX_REPRESENTED_RATIO of their rate.
REPRESENTED_SHARE = 0.9
MAX_REPRESENTED_RATIO = 1.25
DEFAULT_BACKGROUND_STRIDE = 2
MAX_BACKGROUND_STRIDE = 64
BACKGROUND_STRIDE_KEY = "background_stride"
WORLD_AXES = np.eye(3)
MAX_SELECTION_POINTS = 2000
MAX_SAMPLING_CAMERAS = 128  # It bounds the time that a forged file can take.
MAX_PIXEL_SIZE = 1e6  # Local units; larger ones come from broken cameras, and their squares would overflow.
_MIN_DEPTH = 1e-2  # in local units: the renderer's near plane
_MIN_RATE_RATIO = 1e-3  # An unseen point counts as sampled at this share of its rate in all photos.
_POINTS_PER_BLOCK = 1 << 13


@dataclass(frozen=True)
class PhotoCameras:
    """The cameras of the photos that a file keeps, and the spacing at which training evaluated the background.

    Attributes:
        cameras: in world units, at most MAX_SAMPLING_CAMERAS.
        rate_ratio: the sampling rate of all photos at most points, relative to the highest one of these cameras.
        background_stride: pixels between neighbouring nodes of the background in the last training steps.
    """

    cameras: Sequence[Camera]
    rate_ratio: float
    background_stride: int

    @classmethod
    def from_provenance(cls, provenance: dict) -> PhotoCameras:
        """Read an untrusted provenance.

        Of a list of more than MAX_SAMPLING_CAMERAS, the first ones count. If one of these is not valid, the list counts
        as missing.
        """
        stored = provenance.get(BACKGROUND_STRIDE_KEY)
        is_number = isinstance(stored, (int, float)) and not isinstance(stored, bool)
        is_valid = is_number and stored in range(1, MAX_BACKGROUND_STRIDE + 1)  # 3.0 is an integer of JSON, too
        stride = int(cast(float, stored)) if is_valid else DEFAULT_BACKGROUND_STRIDE
        for key in ("cameras", "coarse_cameras"):
            with suppress(TypeError, ValueError, ArithmeticError):
                stored_cameras = list(provenance.get(key) or ())[:MAX_SAMPLING_CAMERAS]
                if cameras := [camera_from_numbers(numbers) for numbers in stored_cameras]:
                    default = COARSE_RATE_RATIO if key == "coarse_cameras" else 1.0
                    return cls(cameras, stored_rate_ratio(provenance, default), stride)
        return cls((), 1.0, stride)

    @property
    def background_spacing(self) -> float:
        """The spacing of the background's nodes in training: the tangent of their angle at the picture's centre.

        0 without cameras.
        """
        return self.background_stride / max(map(focal_length, self.cameras)) if self.cameras else 0.0

    def pixel_sizes(
        self, points: np.ndarray, center: Sequence[float], scale: float, axes: np.ndarray = WORLD_AXES
    ) -> np.ndarray | None:
        """Compute the size of a photo's pixel at each point, of the photo that shows the point at the highest rate.

            q = 1 / (r max over the cameras that see the point of f / z)

        with the focal length f, the depth z and `rate_ratio` r. If none sees the point, f / max(distance, 0.01) is the
        rate of all of them.

        Args:
            points: (N, 3) float32 in local units: local = axes^T (world - center) / scale.
            center: centre of the scene's frame in world units.
            scale: world units of a local unit.
            axes: (3, 3) rotation whose columns are the frame's axes in the world.

        Returns:
            (N,) float32, in local units, at most MAX_PIXEL_SIZE; None without cameras. 0 where cameras beyond float32
            give no size, which limits nothing.
        """
        if not self.cameras:
            return None
        from hyrfpack.parallel.pool import parallel_map  # imports torch, which cameras do without

        sizes = np.empty(len(points), np.float32)

        def fill(start: int) -> None:
            block = slice(start, start + _POINTS_PER_BLOCK)
            with np.errstate(all="ignore"):  # which is kept per thread
                sizes[block] = 1 / self._highest_rates(points[block], np.array(center), scale, axes)

        parallel_map(fill, range(0, len(points), _POINTS_PER_BLOCK))
        sizes /= np.float32(self.rate_ratio)
        sizes[~(sizes <= MAX_PIXEL_SIZE)] = 0  # also where NaN
        return sizes

    def _highest_rates(self, points: np.ndarray, origin: np.ndarray, scale: float, axes: np.ndarray) -> np.ndarray:
        """Return the highest rates (n,) at points (n, 3)."""
        planes = np.ascontiguousarray(points.T)
        best = np.zeros(len(points), np.float32)
        for camera in self.cameras:
            np.maximum(best, _sampling_rates(camera, planes, origin, scale, axes), out=best)
        unseen = np.flatnonzero(best == 0)
        if len(unseen):
            distant = [_rates_by_distance(camera, planes[:, unseen], origin, scale, axes) for camera in self.cameras]
            best[unseen] = np.max(distant, axis=0)
        return best


def stored_rate_ratio(provenance: dict, default: float = 1.0) -> float:
    """Return `rate_ratio` of an untrusted provenance; `default` if it is missing or implausible."""
    stored = provenance.get(RATE_RATIO_KEY)
    is_number = isinstance(stored, (int, float)) and not isinstance(stored, bool)
    return float(cast(float, stored)) if is_number and 1 <= cast(float, stored) <= MAX_RATE_RATIO else default


def select_representative_cameras(
    cameras: Sequence[Camera], points: np.ndarray, scale: float, min_count: int, max_count: int
) -> tuple[list[Camera], float]:
    """Select cameras whose sampling rates come near to those of all cameras, in the given order.

    The first camera is always selected, then, one after the other, the one that raises the mean log rate most, until
    the selected cameras represent all of them (REPRESENTED_SHARE).

    Args:
        cameras: all cameras.
        points: (N, 3) in world units; MAX_SELECTION_POINTS of them are used. Without points, `min_count` cameras are
            evenly spaced.
        scale: world units of a local unit.
        min_count, max_count: limits of the number of selected cameras.

    Returns:
        The cameras, and the rate of all cameras relative to that of the selected ones, 1 or more: it is at most this at
        REPRESENTED_SHARE of the points. 1 without points.
    """
    if len(cameras) <= min_count or not len(points):
        return evenly_spaced(cameras, min_count), 1.0
    points = points[:: -(-len(points) // MAX_SELECTION_POINTS)]
    center = points.mean(axis=0)
    local = ((points - center) / scale).astype(np.float32).T
    with np.errstate(all="ignore"):
        rates = np.stack([_sampling_rates(camera, local, center, scale, WORLD_AXES) for camera in cameras])
        rates = np.nan_to_num(rates, posinf=0)
    highest = rates.max(axis=0)
    floor = np.maximum(_MIN_RATE_RATIO * highest, np.finfo(np.float32).tiny)
    logs, is_seen = np.log(np.maximum(rates, floor)), highest > 0
    all_logs = logs.max(axis=0)
    limit, selected, best, ratio = np.log(MAX_REPRESENTED_RATIO), [0], logs[0], 0.0
    while len(selected) < min(max_count, len(cameras)):
        gains = np.maximum(logs, best).sum(axis=1)
        gains[selected] = -np.inf
        selected.append(int(gains.argmax()))
        best = np.maximum(best, logs[selected[-1]])
        missing = (all_logs - best)[is_seen]
        ratio = float(np.quantile(missing, REPRESENTED_SHARE)) if len(missing) else 0.0
        if len(selected) >= min_count and ratio <= limit:
            break
    return [cameras[index] for index in sorted(selected)], float(np.exp(ratio))


def focal_length(camera: Camera) -> float:
    """Return the larger one of a camera's two focal lengths, in pixels."""
    return max(camera.fx, camera.fy)


def _sampling_rates(
    camera: Camera, points: np.ndarray, center: np.ndarray, scale: float, axes: np.ndarray
) -> np.ndarray:
    """Return f / z (N,) in px per local unit at local points (3, N), 0 where the camera does not see them."""
    width, height, (fx, fy, cx, cy) = camera.width, camera.height, camera.intrinsics
    rotation = camera.rotation
    lens = np.array([[fx], [fy], [1.0]])
    offset = lens[:, 0] * ((rotation @ center + camera.camera_from_world[:3, 3]) / scale)
    x, y, z = (lens * (rotation @ axes)).astype(np.float32) @ points + offset.astype(np.float32)[:, None]
    right, down = PICTURE_MARGIN_RATIO * width, PICTURE_MARGIN_RATIO * height
    is_seen = z > _MIN_DEPTH
    is_seen &= (x >= np.float32(-right - cx) * z) & (x <= np.float32(width + right - cx) * z)
    is_seen &= (y >= np.float32(-down - cy) * z) & (y <= np.float32(height + down - cy) * z)
    return np.divide(np.float32(focal_length(camera)), z, out=np.zeros_like(z), where=is_seen)


def _rates_by_distance(
    camera: Camera, points: np.ndarray, center: np.ndarray, scale: float, axes: np.ndarray
) -> np.ndarray:
    """Return f / distance (N,) in px per local unit at local points (3, N)."""
    position = ((camera.position - center) / scale @ axes).astype(np.float32)[:, None]
    distances = np.linalg.norm(points - position, axis=0)
    return np.float32(focal_length(camera)) / np.maximum(distances, np.float32(_MIN_DEPTH))

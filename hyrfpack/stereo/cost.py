"""Compare a photo with others on planes at many depths."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hyrfpack.scene import Camera
from hyrfpack.stereo.cost_kernels import combine_costs, compare_on_planes, window_means


def sweep_costs(
    camera: Camera, photo: np.ndarray, others: Sequence[tuple[Camera, np.ndarray]], inverses: np.ndarray
) -> np.ndarray:
    """Compare a photo with others on planes that face its camera.

    On the plane at depth z, each other photo is seen from the photo's camera. The cost of a pixel there is one minus
    the correlation of grey values in windows of 2 `WINDOW_RADIUS` + 1 pixels, which does not depend on exposure, and at
    most 1. It is the mean of the better half of the other photos that show the pixel's point, because others may be
    occluded.

    Args:
        camera: the photo's camera.
        photo: (H, W) float32, grey values in [0, 1].
        others: at least one pair of camera and grey values.
        inverses: (P,) inverse depths of the planes, at least 0.

    Returns:
        Costs (H, W, P) float32 in [0, 1]; 1 where no other photo shows the point.
    """
    mean = window_means(photo)
    variance = np.maximum(window_means(photo * photo) - mean * mean, 0)
    inverses, costs = np.asarray(inverses, np.float64), []
    for other, grey in others:
        relative = other.camera_from_world @ np.linalg.inv(camera.camera_from_world)
        homography = _matrix(other) @ relative[:3, :3] @ np.linalg.inv(_matrix(camera))
        offset = _matrix(other) @ relative[:3, 3]
        costs.append(compare_on_planes(photo, mean, variance, grey, homography, offset, inverses))
    return combine_costs(np.stack(costs))


def _matrix(camera: Camera) -> np.ndarray:
    return np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])

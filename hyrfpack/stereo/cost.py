"""Compare a photo with others on planes at many depths: the cost volume of a plane sweep."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hyrfpack.scene import Camera
from hyrfpack.stereo.cost_kernels import compare_on_planes


def compute_cost_volume(
    camera: Camera, photo: np.ndarray, others: Sequence[tuple[Camera, np.ndarray]], inverse_depths: np.ndarray
) -> np.ndarray:
    """Compare a photo with others on planes that face its camera.

    On the plane at depth z, each other photo is seen from the photo's camera. The cost of a pixel there is one minus
    the normalised cross-correlation of grey values in windows of 2 `WINDOW_RADIUS` + 1 pixels, which does not depend on
    exposure, and at most 1. It is the mean of the better half of the other photos that show the pixel's point, because
    it may be occluded in others.

    Args:
        camera: the photo's camera.
        photo: (H, W) float32, grey values in [0, 1].
        others: at least one pair of camera and grey values.
        inverse_depths: (P,) those of the planes, at least 0.

    Returns:
        Costs (H, W, P) float32 in [0, 1]; 1 where no other photo shows the point.
    """
    homographies, offsets = [], []
    for other, _ in others:
        relative = other.camera_from_world @ np.linalg.inv(camera.camera_from_world)
        homographies.append(_intrinsic_matrix(other) @ relative[:3, :3] @ np.linalg.inv(_intrinsic_matrix(camera)))
        offsets.append(_intrinsic_matrix(other) @ relative[:3, 3])
    planes = np.asarray(inverse_depths, np.float64)
    return compare_on_planes(photo, [grey for _, grey in others], np.stack(homographies), np.stack(offsets), planes)


def _intrinsic_matrix(camera: Camera) -> np.ndarray:
    return np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])

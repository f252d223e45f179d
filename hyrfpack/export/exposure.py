"""Local exposure of baked splats: the gains by which the colours are multiplied before splats are fitted to them.

Splats have no exposure map, so their colours include the gains that the map predicts for the cameras that see them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from hyrfpack.model import HybridModel
from hyrfpack.model.exposure import ExposureMap
from hyrfpack.parallel.pool import run_tasks
from hyrfpack.scene import Camera

if TYPE_CHECKING:
    from hyrfpack.export.bake import CameraVisibility

# Without smoothing, the set indoor_room loses 0.18 dB at training cameras that are not fitted. 64 neighbours gain
# another 0.05 dB but take four times as long.
SMOOTHING_NEIGHBORS = 16
GAUSSIANS_PER_TASK = 1 << 16


@dataclass(frozen=True)
class BakeGains:
    """Gains of the colour samples to which the harmonics of Gaussians are fitted.

    Attributes:
        cameras: (V, 3) float32 gains of what each camera sees, as in its render with local exposure.
        gaussians: (N, 3) float32 gains of each Gaussian along directions from which no camera sees it.
    """

    cameras: Tensor
    gaussians: Tensor

    @classmethod
    def predict(
        cls, model: HybridModel, cameras: Sequence[Camera], visibility: Sequence[CameraVisibility]
    ) -> BakeGains | None:
        """Predict the gains of a bake's samples by the exposure map; None without a map, or if all gains are 1.

        The log gain of a Gaussian is a mean over the cameras and over its nearest neighbours, weighted by the light
        that each neighbour sends to each camera; see `smooth_log_gains`.

        Args:
            model: a model on the CPU.
            cameras: the cameras of the bake, world units.
            visibility: result of `compute_visibility` for these cameras.
        """
        if model.exposure is None:
            return None
        logs = predict_camera_log_gains(model, model.exposure, cameras)
        typical = average_log_gains(model.exposure, logs)
        if not (logs.any() or typical.any()):
            return None
        light, sums = np.zeros(len(model)), np.zeros((len(model), 3))
        for camera_visibility, log in zip(visibility, logs, strict=True):
            index, received = camera_visibility.index.numpy(), camera_visibility.light.double().numpy()
            light[index] += received
            sums[index] += received[:, None] * log
        smooth = smooth_log_gains(model.gaussians.positions.detach().numpy(), light, sums, typical)
        return cls(*(torch.from_numpy(np.exp(log_gains)).float() for log_gains in (logs, smooth)))


def predict_camera_log_gains(model: HybridModel, exposure: ExposureMap, cameras: Sequence[Camera]) -> np.ndarray:
    """Predict the log gains (V, 3) of cameras in world units."""
    gains = [exposure.predict_gains(model.config.frame.local_pose(camera)) for camera in cameras]
    return np.log(np.array(gains, np.float64).reshape(-1, 3))


def average_log_gains(exposure: ExposureMap, logs: np.ndarray) -> np.ndarray:
    """Return the mean (3,) of the log gains (V, 3) of cameras; the map's own mean where there are no cameras."""
    return logs.mean(0) if len(logs) else np.clip(exposure.mean, *exposure.limits).astype(np.float64)


def smooth_log_gains(positions: np.ndarray, light: np.ndarray, sums: np.ndarray, typical: np.ndarray) -> np.ndarray:
    """Average the log gains of Gaussians over their nearest neighbours that a camera sees, themselves included.

        log g_i = sum_n sums_n / sum_n light_n        over the SMOOTHING_NEIGHBORS nearest n with light_n > 0

    Args:
        positions: (N, 3).
        light: (N,) >= 0, total light that each Gaussian sends to the cameras.
        sums: (N, 3) sums over the cameras of light times log gain.
        typical: (3,) log gains of all Gaussians if no camera sees any.

    Returns:
        (N, 3) float64, finite.
    """
    smooth = np.broadcast_to(typical, sums.shape).copy()
    is_seen = light > 0
    if not is_seen.any():
        return smooth
    tree, weights, weighted = cKDTree(positions[is_seen]), light[is_seen], sums[is_seen]
    count = min(SMOOTHING_NEIGHBORS, len(weights))

    def smooth_block(block: int) -> None:
        block_slice = slice(block * GAUSSIANS_PER_TASK, (block + 1) * GAUSSIANS_PER_TASK)
        _, nearest = tree.query(positions[block_slice], k=range(1, count + 1))
        smooth[block_slice] = weighted[nearest].sum(1) / weights[nearest].sum(1)[:, None]

    run_tasks(smooth_block, -(-len(positions) // GAUSSIANS_PER_TASK))
    return smooth

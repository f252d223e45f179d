"""Exposure maps for tests."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from hyrfpack.model.exposure import MAX_DIRECTION_CODE, MAX_POSITION_CODE, MAX_WEIGHT_CODE, ExposureMap
from hyrfpack.model.frame import Frame
from hyrfpack.scene import Camera


def random_map(seed: int, centers: int | None = None) -> ExposureMap:
    """Return a valid map of random numbers."""
    rng = np.random.default_rng(seed)
    count = int(rng.integers(0, 12)) if centers is None else centers
    corners = rng.normal(size=(2, 3))
    return ExposureMap(
        box=np.sort(corners, 0).astype(np.float32),
        lengths=rng.uniform(0.1, 3, 2).astype(np.float32),
        mean=rng.normal(size=3).astype(np.float32) * 0.1,
        limits=np.sort(rng.uniform(-2, 2, (2, 3)), 0).astype(np.float32),
        steps=rng.uniform(1e-4, 1e-3, 3).astype(np.float32),
        positions=rng.integers(0, 256, (count, 3)).astype(np.uint8),
        directions=rng.integers(-127, 128, (count, 3)).astype(np.int8),
        weights=rng.integers(-2000, 2001, (count, 3)).astype(np.int16),
    )


def map_with_gains(cameras: Sequence[Camera], frame: Frame, gains: np.ndarray) -> ExposureMap:
    """Return a map that predicts the gains (N, 3) or (N, 1) of N cameras to about 1 %.

    The cameras must look in different directions.
    """
    logs = np.log(np.broadcast_to(gains, (len(cameras), 3)))
    poses = [frame.local_pose(camera) for camera in cameras]
    places, directions = np.array([-p[:3, :3].T @ p[:3, 3] for p in poses]), np.array([p[2, :3] for p in poses])
    low, high = places.min(0), places.max(0)
    codes = np.rint((places - low) / np.maximum(high - low, 1e-9) * MAX_POSITION_CODE)
    turned = np.rint(directions * MAX_DIRECTION_CODE)
    stored = low + codes / MAX_POSITION_CODE * (high - low), turned / MAX_DIRECTION_CODE
    squares = [np.square(part[:, None] - part[None]).sum(-1) for part in stored]
    weights = np.linalg.solve(1 / (1 + squares[0] + squares[1] / 0.25**2), logs)
    steps = np.maximum(np.abs(weights).max(0), 1e-6) / MAX_WEIGHT_CODE
    return ExposureMap(
        box=np.array((low, high), np.float32),
        lengths=np.array((1.0, 0.25), np.float32),
        mean=np.zeros(3, np.float32),
        limits=np.array(((-4.0,) * 3, (4.0,) * 3), np.float32),
        steps=steps.astype(np.float32),
        positions=codes.astype(np.uint8),
        directions=turned.astype(np.int8),
        weights=np.rint(weights / steps).astype(np.int16),
    )


def maps_equal(one: ExposureMap | None, other: ExposureMap | None) -> bool:
    """Return whether two maps hold the same numbers. None differs from every map, and from None."""
    if one is None or other is None:
        return False
    return all(np.array_equal(getattr(one, f.name), getattr(other, f.name)) for f in dataclasses.fields(one))

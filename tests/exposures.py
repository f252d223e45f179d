"""Exposure maps for tests."""

from __future__ import annotations

import numpy as np

from hyrfpack.model.exposure import ExposureMap


def random_map(seed: int, centers: int | None = None) -> ExposureMap:
    """A map of random numbers, as a file could hold them."""
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

"""Synthetic explicit Gaussians for tests of imports."""

from __future__ import annotations

import numpy as np

from hyrfpack.imports import ImportConfig
from hyrfpack.splats.splats import Splats, normalize_quats

TINY_IMPORT_CONFIG = ImportConfig(size=24, views=6, test_views=2)


def ball_splats(count: int, degree: int = 1, seed: int = 0) -> Splats:
    """Return coloured splats on the unit sphere, with random shapes and rotations."""
    rng = np.random.default_rng(seed)
    positions = rng.normal(size=(count, 3))
    return Splats(
        positions / np.linalg.norm(positions, axis=1, keepdims=True),
        rng.uniform(0.03, 0.2, (count, 3)),
        normalize_quats(rng.normal(size=(count, 4))),
        rng.uniform(0.3, 0.95, count),
        0.4 * rng.normal(size=(count, (degree + 1) ** 2, 3)),
    )

"""What is told to a format's `encode` beside the splats: few formats want any of it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from hyrfpack.scene import Camera


@dataclass(frozen=True)
class Hints:
    """Formats that have no use for a hint ignore it.

    Attributes:
        up: (3,) unit vector in the world: which way is up in the scene (glTF, USD).
        camera: to look from first (USD).
        spz_version: 3, one gzip stream, which most programs read, or 4, streams of zstd: smaller and faster (SPZ).
    """

    up: np.ndarray = field(default_factory=lambda: np.array([0.0, -1.0, 0.0]))
    camera: Camera | None = None
    spz_version: int = 3


NO_HINTS = Hints()

"""Optional information that a format's `encode` takes besides the splats; few formats use any of it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from hyrfpack.scene import Camera


@dataclass(frozen=True)
class Hints:
    """Optional information for encoders. A format ignores what it cannot store.

    Attributes:
        up: (3,) unit vector in world axes that points up in the scene (used by glTF and USD).
        camera: the initial camera of the file (used by USD), or None.
        spz_version: version of an SPZ file. 3 is one gzip stream, which most programs read; 4 is several zstd streams,
            smaller and faster.
    """

    up: np.ndarray = field(default_factory=lambda: np.array([0.0, -1.0, 0.0]))
    camera: Camera | None = None
    spz_version: int = 3


NO_HINTS = Hints()

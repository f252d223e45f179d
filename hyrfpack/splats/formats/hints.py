"""Optional information that a format's `encode` takes in addition to the splats; few formats use it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from hyrfpack.choices import DEFAULT_SPZ_VERSION
from hyrfpack.scene import Camera


@dataclass(frozen=True)
class Hints:
    """Optional information for encoders. A format ignores what it cannot store.

    Attributes:
        up: (3,) unit vector in world axes that points up in the scene (used by glTF and USD).
        camera: the initial camera of the file (used by USD), or None.
        spz_version: version of an SPZ file. 4 (May 2026) is several zstd streams, smaller and faster to read; 3 is one
            gzip stream, for programs that do not read 4 yet.
    """

    up: np.ndarray = field(default_factory=lambda: np.array([0.0, -1.0, 0.0]))
    camera: Camera | None = None
    spz_version: int = DEFAULT_SPZ_VERSION


NO_HINTS = Hints()

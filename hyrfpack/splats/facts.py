"""What a file of splats holds, in numbers."""

from __future__ import annotations

import os
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from hyrfpack.splats.names import bytes_on_disk, splats_folder
from hyrfpack.splats.splats import Splats


@dataclass(frozen=True)
class SplatsFacts:
    """What a file of 3D Gaussians holds.

    Attributes:
        file: the path.
        format: "ply", "splat", "spz", "sog", or "sog folder" for a SOG that is not bundled.
        bytes: on disk.
        gaussians: how many.
        degree: of the spherical harmonics.
        antialiased: whether opacities are meant to be compensated for the rasteriser's low-pass filter.
        low, high: (x, y, z) of the box around all centres, world units; None without Gaussians.
        opacity: median; None without Gaussians.
    """

    file: str
    format: str
    bytes: int
    gaussians: int
    degree: int
    antialiased: bool
    low: tuple[float, ...] | None
    high: tuple[float, ...] | None
    opacity: float | None

    def to_dict(self) -> dict:
        """Plain numbers, strings and lists, ready for JSON."""
        return asdict(self)


def describe_splats(path: str | os.PathLike[str], splats: Splats) -> SplatsFacts:
    """Return what the file at `path`, from which `splats` were read, holds."""
    loose = splats_folder(path) is not None
    corners = [tuple(map(float, end(axis=0))) for end in (splats.positions.min, splats.positions.max) if len(splats)]
    low, high = corners or (None, None)
    return SplatsFacts(
        file=str(path),
        format="sog folder" if loose else Path(path).suffix.lower().lstrip("."),
        bytes=bytes_on_disk(path),
        gaussians=len(splats),
        degree=splats.degree,
        antialiased=splats.antialiased,
        low=low,
        high=high,
        opacity=_median(splats),
    )


def _median(splats: Splats) -> float | None:
    return float(np.median(splats.opacities)) if len(splats) else None

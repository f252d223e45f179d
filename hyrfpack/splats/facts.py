"""A summary of a file of splats, in numbers."""

from __future__ import annotations

import os
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from hyrfpack.splats.files import bytes_on_disk
from hyrfpack.splats.names import find_sog_folder
from hyrfpack.splats.splats import Splats


@dataclass(frozen=True)
class SplatsFacts:
    """A summary of a file of 3D Gaussians.

    Attributes:
        file: the path.
        format: "ply", "splat", "spz", "sog", or "sog folder" for an unbundled SOG.
        bytes: size on disk.
        gaussians: number of Gaussians.
        degree: degree of the spherical harmonics.
        antialiased: whether opacities are meant to be compensated for the rasteriser's low-pass filter.
        low, high: (x, y, z) corners of the box around all centres, world units; None without Gaussians.
        opacity: median opacity; None without Gaussians.
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
        """Return the fields as plain numbers, strings and tuples that JSON can hold."""
        return asdict(self)


def describe_splats(path: str | os.PathLike[str], splats: Splats) -> SplatsFacts:
    """Summarise the file at `path`, from which `splats` were read."""
    is_unbundled = find_sog_folder(path) is not None
    corners = [tuple(map(float, end(axis=0))) for end in (splats.positions.min, splats.positions.max) if len(splats)]
    low, high = corners or (None, None)
    return SplatsFacts(
        file=str(path),
        format="sog folder" if is_unbundled else Path(path).suffix.lower().lstrip("."),
        bytes=bytes_on_disk(path),
        gaussians=len(splats),
        degree=splats.degree,
        antialiased=splats.antialiased,
        low=low,
        high=high,
        opacity=_median_opacity(splats),
    )


def _median_opacity(splats: Splats) -> float | None:
    return float(np.median(splats.opacities)) if len(splats) else None

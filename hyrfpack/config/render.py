"""Settings of the geometry that is written beside renders."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from hyrfpack.choices import DEPTH_FORMATS, NORMAL_FORMATS
from hyrfpack.config.settings import OneOf, Range, check_settings

DEFAULT_DEPTH_UNIT = 0.001
MIN_DEPTH_UNIT = 1e-12  # world units; smaller ones count as zero


@dataclass(frozen=True)
class GeometryConfig:
    """Which geometry is written beside renders, and how.

    Attributes:
        depth: write the depth along the view axis, in world units, as float32 (tiff or exr) or as 16-bit steps of
            `depth_unit` (png). Default: none.
        normals: write the normals of surfaces in world axes, as 8 bits (png) or float32 (exr). Default: none.
        depth_unit: world units for each step of a 16-bit depth in a .png.
    """

    depth: Annotated[str | None, OneOf(DEPTH_FORMATS)] = None
    normals: Annotated[str | None, OneOf(NORMAL_FORMATS)] = None
    depth_unit: Annotated[float, Range(MIN_DEPTH_UNIT, unit="length")] = DEFAULT_DEPTH_UNIT

    def __post_init__(self) -> None:
        check_settings(self)

    @property
    def is_wanted(self) -> bool:
        """Whether any geometry is written."""
        return self.depth is not None or self.normals is not None

    @property
    def endings(self) -> tuple[str, ...]:
        """The endings of the files of a view, such as ".depth.png"."""
        extensions = {"depth": self.depth, "normals": self.normals}
        return tuple(f".{kind}.{extension}" for kind, extension in extensions.items() if extension)

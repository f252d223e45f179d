"""Settings of an export and of a conversion of splats."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

from hyrfpack.choices import (
    DEFAULT_SPZ_VERSION,
    LOCAL_EXPOSURE,
    SPLAT_EXPOSURES,
    SPZ_TILE_CONTENT,
    SPZ_VERSIONS,
    TILE_CONTENTS,
)
from hyrfpack.config.settings import OneOf, Range, check_settings

DEFAULT_COLLISION_FACES = 4000
MIN_VOXEL = 1e-12  # world units; smaller ones count as zero


@dataclass(frozen=True)
class ConvertConfig:
    """Settings of a conversion of splats.

    Attributes:
        degree: highest degree of spherical harmonics to keep. Default: the highest that the format can store.
        crop: keep only the Gaussians with centres inside (min x, min y, min z, max x, max y, max z), in world units.
            Infinite numbers leave a side open.
        min_opacity: leave out Gaussians with a lower opacity.
        spz_version: version of .spz files; 3 is for programs that do not read version 4 yet.
    """

    degree: Annotated[int | None, Range(0, 3)] = None
    crop: Sequence[float] | None = None
    min_opacity: Annotated[float, Range(0, 1)] = 0.0
    spz_version: Annotated[int, Range(*SPZ_VERSIONS)] = DEFAULT_SPZ_VERSION

    def __post_init__(self) -> None:
        check_settings(self)
        if self.crop is not None and (len(self.crop) != 6 or any(map(math.isnan, self.crop))):
            raise ValueError(
                f"crop is {self.crop!r}; it must be six numbers, the minimum x, y and z, then the maximum, in world "
                "units"
            )


@dataclass(frozen=True)
class ExportConfig(ConvertConfig):
    """Settings of an export of a model.

    `degree` is the one that colours are baked to; a ".splat" has degree 0. None chooses the lowest degree that scores
    about as well as the best at validation cameras. A cropped scene has no background.

    Attributes:
        background: export the background sphere.
        baked: embed baked splats in an .html page instead of the neural model.
        exposure: exposure of baked splats: each as bright as in the photos that see it (local), or one exposure for all
            (consistent). A model without an exposure map gives the same splats with both.
        colmap: write a folder with a COLMAP model: cameras, and centres as points.
        streamed_sog: write a folder with the levels of detail of a scene folder as PlayCanvas' Streamed SOG.
        tiles_3d: write a folder with the levels of detail of a scene folder as 3D Tiles.
        tile_content: content of 3D Tiles: SPZ in glTF by a draft extension, which CesiumJS draws (spz), or plain glTF,
            which is larger and exact (gltf).
        title: title of a page, a player or a gallery. Default: the name of its file or folder.
        credit: text below the title of a page or a player, such as the author and the licence.
        editable: include a panel in a page or a player that crops, cleans, turns and measures the scene.
        voxel: side of the voxels in which a mesh is fused, in world units. Default: 1.5 times the size of a photo's
            pixel on the surface, and at least 1/512 of the mesh.
        faces: reduce a mesh to at most this number of triangles. Default: all, but 4000 for a .collision file.
    """

    background: bool = True
    baked: bool = False
    exposure: Annotated[str, OneOf(SPLAT_EXPOSURES)] = LOCAL_EXPOSURE
    colmap: bool = False
    streamed_sog: bool = False
    tiles_3d: bool = False
    tile_content: Annotated[str, OneOf(TILE_CONTENTS)] = SPZ_TILE_CONTENT
    title: str | None = None
    credit: str = ""
    editable: bool = False
    voxel: Annotated[float | None, Range(MIN_VOXEL, unit="length")] = None
    faces: Annotated[int | None, Range(4)] = None

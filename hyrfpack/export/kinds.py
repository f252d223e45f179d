"""Which format an export is to be, and what can be refused before minutes of work."""

from __future__ import annotations

import os
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path

import numpy as np

from hyrfpack.errors import HyrfError, needs_package
from hyrfpack.export.cameras import COLMAP_FILES
from hyrfpack.outputs import Outputs
from hyrfpack.splats.files import USD, WRITTEN
from hyrfpack.splats.formats import spz
from hyrfpack.splats.harmonics import MAX_DEGREE

PAGE, TRANSFORMS, COLMAP = ".html", ".json", ""
POINTS = (".points.ply", ".points.glb")
ENDINGS = (*POINTS, *WRITTEN, PAGE, TRANSFORMS)
# What is imported for an ending alone, and what pip calls it.
PACKAGES = {**dict.fromkeys(USD, ("pxr", "usd-core")), ".points.glb": ("trimesh",) * 2, COLMAP: ("pycolmap",) * 2}


def kind_of(target: str | os.PathLike[str]) -> str:
    """The ending that decides the format, one of ENDINGS; COLMAP for a folder or a name without ending.

    Raises:
        HyrfError: it is none of them.
    """
    name = Path(target).name.lower()
    if name.endswith(".compressed.ply"):
        raise HyrfError(
            f"{target}: compressed PLY is read, not written; .sog and .spz are small, .ply is not compressed"
        )
    for kind in ENDINGS:
        if name.endswith(kind):
            return kind
    if os.path.isdir(target) or not Path(name).suffix:
        return COLMAP
    raise HyrfError(
        f"{target}: the ending names the format; end it in one of {', '.join(ENDINGS)}, or name a folder for COLMAP"
    )


def check_request(
    kind: str, target: str | os.PathLike[str], degree: int, crop: Sequence[float] | None, min_opacity: float
) -> None:
    """Refuse what would fail later on: see `export`. Raises HyrfError."""
    if degree not in range(MAX_DEGREE + 1):
        raise HyrfError(f"spherical harmonics of degree {degree} are not known; name 0 to {MAX_DEGREE}")
    if crop is not None and (np.shape(crop) != (6,) or np.isnan(crop).any()):
        raise HyrfError(f"the crop {crop} is no box; name the least x, y, z, then the greatest, in world units")
    if not 0 <= min_opacity <= 1:
        raise HyrfError(f"an opacity of {min_opacity} cannot be asked for; name 0 to 1")
    if kind == TRANSFORMS and (crop is not None or min_opacity > 0):
        raise HyrfError(
            f"{target}: this holds cameras only, and --crop and --min-opacity choose Gaussians; leave them out"
        )
    if kind in PACKAGES:
        module, package = PACKAGES[kind]
        with needs_package(package, f"{target}: writing this format"):
            import_module(module)


def check_place(target: str | os.PathLike[str], outputs: Outputs) -> None:
    """Refuse a target that may not or cannot be written. Raises HyrfError."""
    if kind_of(target) == COLMAP:
        outputs.folder(target, COLMAP_FILES)
    else:
        outputs.file(target)


def check_reach(kind: str, reach: float) -> None:
    """Refuse what a format cannot place: splats up to `reach` world units along an axis. Raises HyrfError."""
    if kind == ".spz" and reach > spz.FARTHEST:
        raise HyrfError(
            f"the scene reaches {reach:,.0f} units from the origin with its background, and .spz {spz.FARTHEST:,}; "
            "export another format, or try --no-background"
        )

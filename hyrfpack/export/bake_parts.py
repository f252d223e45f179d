"""Bake of all parts of a merged model: each part by itself, in the axes and units of the world.

The frame of a part places it in the world, and `bake` turns its harmonics by it, so all splats can be drawn together.
The cameras are those of the scene. That parts hide each other would only change the weights of colour samples, and is
not taken into account.
"""

from __future__ import annotations

from collections.abc import Sequence

from hyrfpack.export.bake import CameraVisibility, bake, compute_visibility
from hyrfpack.model import HybridModel
from hyrfpack.model.merged import MergedModel, parts_of
from hyrfpack.progress import Progress, ignore_progress, part_of_progress
from hyrfpack.scene import Camera
from hyrfpack.splats.splats import Splats, concatenate

# The visibility of each part.
PartsVisibility = Sequence[Sequence[CameraVisibility]]


def compute_parts_visibility(
    model: HybridModel | MergedModel, cameras: Sequence[Camera], progress: Progress = ignore_progress
) -> PartsVisibility:
    """Compute what cameras see of each part alone; see `compute_visibility`."""
    parts = parts_of(model)
    return [
        compute_visibility(part, cameras, part_of_progress(progress, number / len(parts), (number + 1) / len(parts)))
        for number, part in enumerate(parts)
    ]


def bake_parts(
    model: HybridModel | MergedModel,
    cameras: Sequence[Camera],
    degrees: Sequence[int] = (3,),
    visibility: PartsVisibility | None = None,
    progress: Progress = ignore_progress,
) -> dict[int, Splats]:
    """Bake all parts of a model, in order, for each degree of spherical harmonics; see `bake`.

    Args:
        model: a model on the CPU.
        cameras: cameras from which it was photographed, world units.
        degrees: degrees of the harmonics, each 0 to 3.
        visibility: result of `compute_parts_visibility` for these cameras, if it is known already.
        progress: called with `TaskEvent`s.

    Raises:
        HyrfError: as `bake`.
    """
    parts, baked = parts_of(model), []
    for number, part in enumerate(parts):
        part_visibility = None if visibility is None else visibility[number]
        share = part_of_progress(progress, number / len(parts), (number + 1) / len(parts))
        baked.append(bake(part, cameras, degrees, part_visibility, share))
    return {degree: concatenate([splats[degree] for splats in baked]) for degree in degrees}

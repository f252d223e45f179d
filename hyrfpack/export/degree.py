"""Which degree of spherical harmonics a scene wants: more can be worse where few cameras say what colours do."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from hyrfpack.cameras.view_sampling import shrink_camera
from hyrfpack.export.bake import Sight, bake
from hyrfpack.export.measure import likeness
from hyrfpack.export.source import FEW, MEASURED
from hyrfpack.model import HybridModel
from hyrfpack.progress import Report, no_report, report_part
from hyrfpack.scene import Camera, evenly_spaced

# Every ninth of the cameras, from the fifth on, is not fitted but chosen by; of those that `Source` makes up,
# which stand three above one another, it is a middle one.
KEPT_BACK = slice(4, None, 9)
MANY = 200_000  # Gaussians; of more, so many spread over them are chosen by, drawn by themselves
TOLERANCE = 0.2  # dB that a lower degree, which takes fewer bytes, may score less than the best


def choose_degree(
    model: HybridModel,
    cameras: Sequence[Camera],
    highest: int,
    sights: Sequence[Sight] | None = None,
    report: Report = no_report,
) -> tuple[int, dict[int, float]]:
    """The lowest degree of harmonics, 0 to `highest`, that looks as good as any, and the score of each, dB.

    The model is baked at all degrees with every ninth of the cameras kept back, and its pictures (of at most 512
    pixels, without the background) are compared with the model's from those. Where there are too few cameras to spare
    one (fewer than FEW), all are fitted and compared: nothing then tells a degree that fits too well from a good one.
    Where there are MANY Gaussians and more, some are enough.

    Args:
        model: on the CPU.
        cameras: that colours shall be fitted at, world units; none of those that a result will be judged by.
        highest: degree to think of, 0 to 3.
        sights: what `sights_of` told of the cameras, where it is known already.
        report: called with what is being done and the share of the work that is done, 0 to 1.
    """
    fitted, kept = list(cameras), list(cameras)
    every = -(-len(model) // MANY)
    if every > 1:
        model, sights = model.part(torch.arange(0, len(model), every)), None
    seen = None if sights is None else list(sights)
    if len(cameras) >= FEW:
        kept = fitted[KEPT_BACK]
        for some in (fitted, seen or []):
            del some[KEPT_BACK]
    baked = bake(model, fitted, range(highest + 1), seen, report_part(report, 0.0, 0.6))
    contenders = {str(degree): (splats, None) for degree, splats in baked.items()}
    views = [(shrink_camera(camera), None) for camera in evenly_spaced(kept, MEASURED)]
    found = likeness(model, contenders, views, sphere=False, report=report_part(report, 0.6, 1.0))
    scores = {degree: found[str(degree)].model for degree in baked}
    return lowest_as_good(scores), scores


def lowest_as_good(scores: dict[int, float]) -> int:
    """The lowest degree whose score is within TOLERANCE of the best."""
    return min(degree for degree, score in scores.items() if score >= max(scores.values()) - TOLERANCE)

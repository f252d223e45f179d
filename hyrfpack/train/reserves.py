"""Estimates how much memory the next rendering of each training view needs on a GPU."""

from __future__ import annotations

import math
from dataclasses import dataclass

from hyrfpack.render.reserve import Reserve
from hyrfpack.scene import View

RESERVE_RATIO = 1.5  # Between two renderings of a view its counts grow less than this in most steps.
INITIAL_PAIRS_PER_GAUSSIAN = 8
MIN_RESERVED_PAIRS = 4096


@dataclass(frozen=True)
class _Usage:
    """What the last rendering of a view needed: Gaussians in view and pairs; of how many Gaussians, on which side."""

    in_view: int
    pairs: int
    gaussians: int
    side_pixels: float


class ReserveEstimator:
    """The counts of each view's last rendering, and from them the reserve for its next one.

    A reserve that is too small costs a step that has to be retaken; one that is too large costs memory and sorting.
    """

    def __init__(self) -> None:
        self._usages: dict[str, _Usage] = {}

    def estimate(self, view: View, gaussians: int) -> Reserve:
        """Return the reserve for a view of a model with so many Gaussians.

        It is `RESERVE_RATIO` times what the view needed last, and more if there are more Gaussians or pixels now. Pairs
        of a view that was not rendered yet are those of the view with the most; all its Gaussians may be in view.
        """
        usage = self._usages.get(view.name)
        if usage is not None:
            growth = RESERVE_RATIO * max(1.0, gaussians / max(1, usage.gaussians))
            in_view = min(gaussians, math.ceil(growth * usage.in_view))
        else:
            in_view = gaussians
            usage = max(self._usages.values(), key=lambda other: other.pairs, default=None)
        if usage is None:
            pairs = INITIAL_PAIRS_PER_GAUSSIAN * gaussians
        else:
            growth = RESERVE_RATIO * max(1.0, gaussians / max(1, usage.gaussians))
            # The pairs of Gaussians of many tiles grow as the area, those of smaller ones do not grow.
            pairs = math.ceil(growth * max(1.0, _side_pixels(view) / usage.side_pixels) * usage.pairs)
        return Reserve(max(1, in_view), max(MIN_RESERVED_PAIRS, pairs))

    def record(self, view: View, gaussians: int, in_view: int, pairs: int) -> None:
        """Record what a rendering of a view needed, of a model with so many Gaussians."""
        self._usages[view.name] = _Usage(in_view, pairs, gaussians, _side_pixels(view))


def _side_pixels(view: View) -> float:
    return math.sqrt(view.camera.width * view.camera.height)

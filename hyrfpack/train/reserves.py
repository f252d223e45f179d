"""Estimates how much memory the next rendering of each training view needs on a GPU."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from hyrfpack.render.reserve import Reserve
from hyrfpack.scene import View

RESERVE_RATIO = 1.5  # Between two renderings of a view its counts grow less than this in most steps.
INITIAL_PAIRS_PER_GAUSSIAN = 8
MIN_RESERVED_PAIRS = 4096
# A reserve for all views is estimated anew if a view needs more than 1 / SHARED_RESERVE_RATIO of it.
SHARED_RESERVE_RATIO = 1.15
SHARED_RESERVE_BITS = 3


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
        self._shared: dict[tuple[int, float], Reserve] = {}  # By number of Gaussians and side in pixels.

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

    def estimate_shared(self, views: Sequence[View], view: View, gaussians: int) -> Reserve:
        """Return the largest estimate of these views, at the size of `view`, rounded up.

        It stays the same until the number of Gaussians changes or a view nearly exceeds it.
        """
        key = gaussians, _side_pixels(view)
        if key not in self._shared:
            self._shared = {known: reserve for known, reserve in self._shared.items() if known[0] == gaussians}
            known = [other for other in views if other.name in self._usages]
            others = [*known, *([View("", view.camera, view.load)] if len(known) < len(views) else [])]
            reserves = [self.estimate(replace(other, camera=view.camera), gaussians) for other in others]
            in_view, pairs = (max(getattr(one, name) for one in reserves) for name in ("gaussians", "pairs"))
            self._shared[key] = Reserve(min(gaussians, _round_up(in_view)), _round_up(pairs))
        return self._shared[key]

    def record(self, view: View, gaussians: int, in_view: int, pairs: int) -> None:
        """Record what a rendering of a view needed, of a model with so many Gaussians."""
        self._usages[view.name] = _Usage(in_view, pairs, gaussians, _side_pixels(view))
        shared = self._shared.get((gaussians, _side_pixels(view)))
        if shared is not None:
            has_room = shared.gaussians == gaussians or SHARED_RESERVE_RATIO * in_view <= shared.gaussians
            if not has_room or SHARED_RESERVE_RATIO * pairs > shared.pairs:
                del self._shared[gaussians, _side_pixels(view)]


def _round_up(count: int) -> int:
    """Round a count up to a number of SHARED_RESERVE_BITS binary digits and then zeros."""
    step = 1 << max(0, count.bit_length() - SHARED_RESERVE_BITS)
    return -(-count // step) * step


def _side_pixels(view: View) -> float:
    return math.sqrt(view.camera.width * view.camera.height)

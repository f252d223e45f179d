"""How far a `make` is, and how long it will take."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from time import monotonic

SURE_SHARE, SURE_SECONDS = 0.02, 2.0  # of a stage, from which on its pace says how long it takes


@dataclass(frozen=True)
class Progress:
    """Where the work is.

    Attributes:
        stage: "poses", "measurement", "training", "compression", "export", "scoring" or "import".
        place, of: it is the place-th of so many stages.
        share: of the stage that is done, 0 to 1; 0 where it cannot tell.
        left: seconds until all stages are done, by estimate; None where there is none yet.
        words: what there is to say of the stage, the most important first.
    """

    stage: str
    place: int
    of: int
    share: float
    left: float | None
    words: tuple[str, ...] = ()


class Reporter:
    """Tells of progress, and forecasts what is left.

    Attributes:
        estimates: seconds of stages to come, by name, as far as can be said before.
    """

    def __init__(self, stages: Sequence[str], report: Callable[[Progress], None] | None) -> None:
        self.estimates: dict[str, float] = {}
        self._stages = tuple(stages)
        self._report = report
        self._stage, self._began, self._first = stages[0], monotonic(), 0.0

    def begin(self, stage: str, *words: str) -> None:
        self._stage, self._began, self._first = stage, monotonic(), -1.0
        self.update(0.0, *words)

    def update(self, share: float, *words: str) -> None:
        """Args: share: of the present stage that is done."""
        if self._report is None:
            return
        if self._first < 0 < share:  # of a stage that is gone on with, much may be done at once
            self._first = share
        place = self._stages.index(self._stage)
        left = self._left_of_stage(share)
        if left is not None:
            left += sum(self.estimates.get(stage, 0.0) for stage in self._stages[place + 1 :])
        self._report(Progress(self._stage, place + 1, len(self._stages), share, left, words))

    def _left_of_stage(self, share: float) -> float | None:
        gone, done = monotonic() - self._began, share - max(self._first, 0.0)
        if done >= SURE_SHARE and gone >= SURE_SECONDS:
            return gone * (1 - share) / done
        if self._stage not in self.estimates:
            return None
        return max(0.0, self.estimates[self._stage] * (1 - share) - (gone if share == 0 else 0.0))

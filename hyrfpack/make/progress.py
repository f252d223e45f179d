"""How far a `make` is, and how long it will take."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from time import monotonic

# Training: short runs that measure the budget, the run itself, its scores and pictures.
STAGE_PARTS = {"training": ("pilots", "training", "results")}
PACED_PARTS = ("pilots", "training")  # steps that are all alike: their pace says how fast the machine is
UNPACED_PARTS = ("poses", "measurement")  # limited by something else than what training is limited by
MIN_PACE_SHARE, MIN_PACE_SECONDS = 0.01, 2.0  # of a part, from which on its pace says how long it takes
MIN_SAMPLE_SECONDS = 0.5  # between two shares that are remembered
MAX_SAMPLES = 200  # of equal distance in time; there are more because the first ones are closer together
TRUSTED_SECONDS = 20.0  # from which on the measured pace alone counts, and the forecast no longer
OVERDUE_RATIO = 0.25  # of the time that an overdue part has taken: what it may take still
SLOWDOWN_LIMITS = 0.1, 20.0  # of measured to forecast seconds
# A busy machine slows a training, which waits for all its threads many times a step, more than what follows it.
SLOWDOWN_EXPONENT = 0.7


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
    """Reports progress and estimates the time that is left.

    A stage has one or more parts, which follow each other. Before a part its time is known by a forecast only. While it
    works, its pace during the last half of its time counts more and more. Where the paced parts take longer than their
    forecast, because the machine is slow or busy, the forecasts of the later ones are scaled, too.

    Attributes:
        estimates: seconds of the parts, by name, as far as they can be forecast.
    """

    def __init__(self, stages: Sequence[str], report: Callable[[Progress], None] | None) -> None:
        self.estimates: dict[str, float] = {}
        self._stages = tuple(stages)
        self._report = report
        self._watch: Callable[[], None] = lambda: None
        self._part = parts_of(stages[0])[0]
        self._samples: list[tuple[float, float]] = []  # time and share, of the present part
        self._began, self._share, self._shown, self._slowdown = monotonic(), 0.0, 0.0, 1.0

    @contextmanager
    def watched_by(self, watch: Callable[[], None]) -> Iterator[None]:
        """Call a function at each report while the block runs."""
        self._watch = watch
        try:
            yield
        finally:
            self._watch = lambda: None

    def begin(self, stage: str, *words: str) -> None:
        """Report that a stage begins, with its first part."""
        self._shown = 0.0
        self.begin_part(parts_of(stage)[0], *words)

    def begin_part(self, part: str, *words: str) -> None:
        """Report that a part of the present stage begins, or begins anew: its pace is measured from here on."""
        self._part, self._began, self._samples = part, monotonic(), []
        self.update(0.0, *words)

    def skip(self, stage: str, seconds: float) -> None:
        """Take in that an earlier call has done a stage, in so many seconds."""
        if stage in STAGE_PARTS:
            forecast = sum(self.estimates.get(part, 0.0) for part in parts_of(stage))
            self._set_slowdown(seconds, forecast)

    def update(self, share: float, *words: str) -> None:
        """Report how far the present part is.

        Args:
            share: of the part that is done, 0 to 1; 0 where it cannot tell.
            words: what there is to say of it, the most important first.
        """
        self._watch()
        self._share = share
        if self._report is None:
            return
        now = monotonic()
        least = max(MIN_SAMPLE_SECONDS, (now - self._began) / MAX_SAMPLES)
        if share > 0 and (not self._samples or now - self._samples[-1][0] >= least):
            self._samples.append((now, share))
        stage = stage_of(self._part)
        place, left = self._stages.index(stage), self._left_of_part(share, now)
        self._shown = max(self._shown, self._share_of_stage(share))
        if left is not None:
            left += sum(self._forecast(part) for part in self._later_parts())
        self._report(Progress(stage, place + 1, len(self._stages), self._shown, left, words))

    def tell(self, doing: str, share: float) -> None:
        """`update` in the form in which library functions report."""
        self.update(share, doing)

    def say(self, sentence: str) -> None:
        """Report what the present part is doing; its share stays as it was."""
        self.update(self._share, sentence)

    def _left_of_part(self, share: float, now: float) -> float | None:
        """Seconds until the present part is done; None where nothing tells."""
        gone = now - self._began
        forecast = self._forecast(self._part) if self._part in self.estimates else None
        if (pace := self._pace(share, now)) is not None:
            measured, trust = (1 - share) / pace, min(1.0, gone / TRUSTED_SECONDS)
            if self._part in PACED_PARTS:
                self._set_slowdown(1 / pace, self.estimates.get(self._part, 0.0))
            if forecast is None:
                return measured
            return trust * measured + (1 - trust) * forecast * (1 - share)
        if forecast is None:
            return None
        # A part that outlasts its forecast is not about to end: the longer it has taken, the longer it may take.
        return max(forecast * (1 - share) - (gone if share == 0 else 0.0), OVERDUE_RATIO * gone)

    def _pace(self, share: float, now: float) -> float | None:
        """Shares a second during the last half of the present part; None where too little is done to tell."""
        middle = now - (now - self._began) / 2
        samples = self._samples or [(now, share)]
        since, first = next((sample for sample in reversed(samples) if sample[0] <= middle), samples[0])
        gone, done = now - since, share - first
        return done / gone if done >= MIN_PACE_SHARE and gone >= MIN_PACE_SECONDS else None

    def _set_slowdown(self, seconds: float, forecast: float) -> None:
        if forecast > 0 and seconds > 0:
            low, high = SLOWDOWN_LIMITS
            self._slowdown = min(max(seconds / forecast, low), high)

    def _forecast(self, part: str) -> float:
        """Seconds that a part will take, as far as the forecast and the pace of the paced parts tell."""
        exponent = 0.0 if part in UNPACED_PARTS else 1.0 if part in PACED_PARTS else SLOWDOWN_EXPONENT
        return self._slowdown**exponent * self.estimates.get(part, 0.0)

    def _later_parts(self) -> list[str]:
        parts = [part for stage in self._stages for part in parts_of(stage)]
        return parts[parts.index(self._part) + 1 :]

    def _share_of_stage(self, share: float) -> float:
        """The share of the present stage, by the forecasts of its parts."""
        parts = parts_of(stage_of(self._part))
        place = parts.index(self._part)
        forecasts = [self.estimates.get(part, 0.0) for part in parts]
        if len(parts) == 1 or not forecasts[place] > 0:
            return share
        return (sum(forecasts[:place]) + share * forecasts[place]) / sum(forecasts)


def parts_of(stage: str) -> tuple[str, ...]:
    """The parts of a stage, in order."""
    return STAGE_PARTS.get(stage, (stage,))


def stage_of(part: str) -> str:
    """The stage that a part belongs to."""
    return next((stage for stage, parts in STAGE_PARTS.items() if part in parts), part)

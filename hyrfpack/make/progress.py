"""Report the progress of a pipeline and estimate the time that is left."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from time import monotonic

# Training consists of pilot runs that decide settings, the run itself, and its scores and pictures.
STAGE_PARTS = {"training": ("pilots", "training", "results")}
PACED_PARTS = ("pilots", "training")  # all steps are alike, so their pace shows how fast the machine is
UNPACED_PARTS = ("poses", "measurement")  # their time does not depend on the pace of training
# The pace of a part is used once at least this share of the part and this time have passed.
MIN_PACE_SHARE = 0.01
MIN_PACE_SECONDS = 2.0
MIN_SAMPLE_INTERVAL_SECONDS = 0.5
MAX_SAMPLES = 200  # number of evenly spaced samples; there may be more, because the first ones are closer together
FULL_TRUST_SECONDS = 20.0  # after this time only the measured pace counts, not the forecast
OVERDUE_TIME_RATIO = 0.25  # an overdue part is expected to take this ratio of its elapsed time in addition
# Limits of the slowdown, the ratio of measured to forecast seconds.
MIN_SLOWDOWN = 0.1
MAX_SLOWDOWN = 20.0
# A busy machine slows training more than the stages after it, because a training step waits for all threads many times.
SLOWDOWN_EXPONENT = 0.7


@dataclass(frozen=True)
class Progress:
    """Progress of a pipeline.

    Attributes:
        stage: "poses", "measurement", "training", "compression", "export", "scoring" or "import".
        place: number of the stage, counted from 1.
        of: number of all stages.
        share: share of the stage that is done, 0 to 1; 0 if it is unknown.
        left: estimated seconds until all stages are done; None if there is no estimate yet.
        words: descriptions of the current work, the most important first.
    """

    stage: str
    place: int
    of: int
    share: float
    left: float | None
    words: tuple[str, ...] = ()


class Reporter:
    """Reports progress and estimates the time that is left.

    A stage has one or more parts, which follow each other. Before a part begins, its time is known only from a
    forecast. While it runs, the measured pace gradually replaces the forecast. If the paced parts take longer than
    their forecast, because the machine is slow or busy, the forecasts of later parts are scaled as well.

    Attributes:
        estimates: forecast seconds of parts by name, as far as known.
    """

    def __init__(self, stages: Sequence[str], report: Callable[[Progress], None] | None) -> None:
        self.estimates: dict[str, float] = {}
        self._stages = tuple(stages)
        self._report = report
        self._call_watcher: Callable[[], None] = lambda: None
        self._part = parts_of(stages[0])[0]
        self._samples: list[tuple[float, float]] = []  # (time, share) of the current part
        self._began, self._share, self._shown, self._slowdown = monotonic(), 0.0, 0.0, 1.0

    @contextmanager
    def watched_by(self, watcher: Callable[[], None]) -> Iterator[None]:
        """Call `watcher` at each report while the block runs."""
        self._call_watcher = watcher
        try:
            yield
        finally:
            self._call_watcher = lambda: None

    def begin(self, stage: str, *words: str) -> None:
        """Report that a stage and its first part begin."""
        self._shown = 0.0
        self.begin_part(parts_of(stage)[0], *words)

    def begin_part(self, part: str, *words: str) -> None:
        """Report that a part of the current stage begins or is restarted; its pace is measured from now on."""
        self._part, self._began, self._samples = part, monotonic(), []
        self.update(0.0, *words)

    def skip(self, stage: str, seconds: float) -> None:
        """Record that an earlier call has finished a stage in `seconds`, which shows how fast the machine is."""
        if stage in STAGE_PARTS:
            forecast = sum(self.estimates.get(part, 0.0) for part in parts_of(stage))
            self._set_slowdown(seconds, forecast)

    def update(self, share: float, *words: str) -> None:
        """Report the progress of the current part.

        Args:
            share: share of the part that is done, 0 to 1; 0 if it is unknown.
            words: descriptions of the current work, the most important first.
        """
        self._call_watcher()
        self._share = share
        if self._report is None:
            return
        now = monotonic()
        least = max(MIN_SAMPLE_INTERVAL_SECONDS, (now - self._began) / MAX_SAMPLES)
        if share > 0 and (not self._samples or now - self._samples[-1][0] >= least):
            self._samples.append((now, share))
        stage = stage_of(self._part)
        index, left = self._stages.index(stage), self._estimate_part_seconds(share, now)
        self._shown = max(self._shown, self._share_of_stage(share))
        if left is not None:
            left += sum(self._forecast(part) for part in self._later_parts())
        self._report(Progress(stage, index + 1, len(self._stages), self._shown, left, words))

    def report_share(self, doing: str, share: float) -> None:
        """Report progress with the arguments of a `hyrfpack.progress.Report`."""
        self.update(share, doing)

    def say(self, sentence: str) -> None:
        """Report a description of the current work without changing the share."""
        self.update(self._share, sentence)

    def _estimate_part_seconds(self, share: float, now: float) -> float | None:
        """Estimate the seconds until the current part is done; None if there is neither a forecast nor a pace."""
        elapsed = now - self._began
        forecast = self._forecast(self._part) if self._part in self.estimates else None
        if (pace := self._pace(share, now)) is not None:
            measured, trust = (1 - share) / pace, min(1.0, elapsed / FULL_TRUST_SECONDS)
            if self._part in PACED_PARTS:
                self._set_slowdown(1 / pace, self.estimates.get(self._part, 0.0))
            if forecast is None:
                return measured
            return trust * measured + (1 - trust) * forecast * (1 - share)
        if forecast is None:
            return None
        # The longer a part has outlasted its forecast, the longer it is expected to take.
        return max(forecast * (1 - share) - (elapsed if share == 0 else 0.0), OVERDUE_TIME_RATIO * elapsed)

    def _pace(self, share: float, now: float) -> float | None:
        """Return the shares per second during the last half of the current part; None if too little is done."""
        middle = now - (now - self._began) / 2
        samples = self._samples or [(now, share)]
        since, first = next((sample for sample in reversed(samples) if sample[0] <= middle), samples[0])
        elapsed, done = now - since, share - first
        return done / elapsed if done >= MIN_PACE_SHARE and elapsed >= MIN_PACE_SECONDS else None

    def _set_slowdown(self, seconds: float, forecast: float) -> None:
        """Set the slowdown of the machine from the measured and the forecast seconds of a paced part."""
        if forecast > 0 and seconds > 0:
            self._slowdown = min(max(seconds / forecast, MIN_SLOWDOWN), MAX_SLOWDOWN)

    def _forecast(self, part: str) -> float:
        """Return the forecast seconds of a part, scaled by the slowdown of the machine."""
        exponent = 0.0 if part in UNPACED_PARTS else 1.0 if part in PACED_PARTS else SLOWDOWN_EXPONENT
        return self._slowdown**exponent * self.estimates.get(part, 0.0)

    def _later_parts(self) -> list[str]:
        """Return the parts after the current one, of all stages."""
        parts = [part for stage in self._stages for part in parts_of(stage)]
        return parts[parts.index(self._part) + 1 :]

    def _share_of_stage(self, share: float) -> float:
        """Convert the share of the current part to that of its stage, by the forecasts of all its parts."""
        parts = parts_of(stage_of(self._part))
        index = parts.index(self._part)
        forecasts = [self.estimates.get(part, 0.0) for part in parts]
        if len(parts) == 1 or not forecasts[index] > 0:
            return share
        return (sum(forecasts[:index]) + share * forecasts[index]) / sum(forecasts)


def parts_of(stage: str) -> tuple[str, ...]:
    """Return the parts of a stage, in order."""
    return STAGE_PARTS.get(stage, (stage,))


def stage_of(part: str) -> str:
    """Return the stage to which a part belongs."""
    return next((stage for stage, parts in STAGE_PARTS.items() if part in parts), part)

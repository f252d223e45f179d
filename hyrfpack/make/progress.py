"""Report the progress of a pipeline and estimate the time that is left."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from time import monotonic

from hyrfpack.progress import Event, Progress, StageEvent, TaskEvent
from hyrfpack.progress.pace import SharePace
from hyrfpack.progress.status import OVERDUE_TIME_RATIO

# Training consists of pilot runs that decide settings, teacher runs, the run itself, and its scores and pictures.
STAGE_PARTS = {"training": ("pilots", "teachers", "training", "results")}
PACED_PARTS = ("pilots", "teachers", "training")  # all steps are alike, so their pace shows how fast the machine is
UNPACED_PARTS = ("poses", "measurement")  # their time does not depend on the pace of training
FULL_TRUST_SECONDS = 20.0  # after this time only the measured pace counts, not the forecast
# Limits of the slowdown, the ratio of measured to forecast seconds.
MIN_SLOWDOWN = 0.1
MAX_SLOWDOWN = 20.0
# A busy machine slows training more than the stages after it, because a training step waits for all threads many times.
SLOWDOWN_EXPONENT = 0.7


class Reporter:
    """Reports progress and estimates the time that is left.

    A stage has one or more parts, which follow each other. Before a part begins, its time is known only from a
    forecast. While it runs, the measured pace gradually replaces the forecast. If the paced parts take longer than
    their forecast, because the machine is slow or busy, the forecasts of later parts are scaled as well.

    Attributes:
        estimates: forecast seconds of parts by name, as far as known.
    """

    def __init__(self, stages: Sequence[str], progress: Progress, stop: Callable[[], bool] | None = None) -> None:
        """Prepare to report the stages.

        Args:
            stages: their names, in the order in which they run.
            progress: called with `StageEvent`s.
            stop: returns whether to stop, see `RunContext`. Training calls it by itself, because it saves a checkpoint
                before it stops.
        """
        self.estimates: dict[str, float] = {}
        self._stages = tuple(stages)
        self._progress = progress
        self._stop = stop
        self._call_watcher: Callable[[], None] = lambda: None
        self._part = parts_of(stages[0])[0]
        self._pace = SharePace(monotonic())  # of the current part
        self._part_share, self._reported_stage_share, self._slowdown = 0.0, 0.0, 1.0

    @contextmanager
    def watched_by(self, watcher: Callable[[], None]) -> Iterator[None]:
        """Call `watcher` at each report while the block runs."""
        self._call_watcher = watcher
        try:
            yield
        finally:
            self._call_watcher = lambda: None

    def begin(self, stage: str, *descriptions: str) -> None:
        """Report that a stage and its first part begin."""
        self._reported_stage_share = 0.0
        self.begin_part(parts_of(stage)[0], *descriptions)

    def begin_part(self, part: str, *descriptions: str) -> None:
        """Report that a part of the current stage begins or is restarted; its pace is measured from now on."""
        self._part, self._pace = part, SharePace(monotonic())
        self.update(0.0, *descriptions)

    def skip(self, stage: str, seconds: float) -> None:
        """Record that an earlier call has finished a stage in `seconds`, which shows how fast the machine is."""
        if stage in STAGE_PARTS:
            forecast = sum(self.estimates.get(part, 0.0) for part in parts_of(stage))
            self._set_slowdown(seconds, forecast)

    def update(self, share: float, *descriptions: str) -> None:
        """Report the progress of the current part.

        Args:
            share: share of the part that is done, 0 to 1; 0 if it is unknown.
            descriptions: descriptions of the current work, the most important first.

        Raises:
            KeyboardInterrupt: the call is to stop, outside of the training.
        """
        if self._stop is not None and stage_of(self._part) != "training" and self._stop():
            raise KeyboardInterrupt
        self._call_watcher()
        self._part_share = share
        now = monotonic()
        self._pace.add(share, now)
        stage = stage_of(self._part)
        number, seconds_left = self._stages.index(stage) + 1, self._estimate_part_seconds(share, now)
        if seconds_left is not None:
            seconds_left += sum(self._forecast(part) for part in self._later_parts())
        self._reported_stage_share = max(self._reported_stage_share, self._share_of_stage(share))
        event = StageEvent(stage, number, len(self._stages), self._reported_stage_share, seconds_left, descriptions)
        self._progress(event)

    def report_event(self, event: Event) -> None:
        """Report the progress of a call that does the current part; without a share, only its description."""
        if isinstance(event, TaskEvent):
            self.update(self._part_share if event.share is None else event.share, str(event))

    def _estimate_part_seconds(self, share: float, now: float) -> float | None:
        """Estimate the seconds until the current part is done; None if there is neither a forecast nor a pace."""
        elapsed = now - self._pace.start
        forecast = self._forecast(self._part) if self._part in self.estimates else None
        if (pace := self._pace.at(share, now)) is not None:
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

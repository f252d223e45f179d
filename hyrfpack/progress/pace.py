"""Speed of long work, as it was measured so far, from which the remaining time follows."""

from __future__ import annotations

from hyrfpack.progress.events import StepEvent

COMPILATION_STEPS = 2  # The first steps of a run compile kernels, so they do not count for the speed.
# A pace is known once at least this share of the work is done and this time has passed.
MIN_PACE_SHARE = 0.01
MIN_PACE_SECONDS = 2.0
MIN_SAMPLE_INTERVAL_SECONDS = 0.5
MAX_SAMPLES = 200  # Number of evenly spaced samples; there may be more, because the first ones are closer together.


class StepPace:
    """Measures the pace of a training run since its kernels were compiled.

    Attributes:
        warm: time, in seconds, at which all kernels were compiled.
        warm_step: the step after which all kernels were compiled.
    """

    def __init__(self, done: int, start: float) -> None:
        """Begin at time `start`, after `done` steps."""
        self.first, self.warm_step = done, done
        self.start = self.warm = start
        self._warm_share: float | None = None

    def at(self, event: StepEvent, now: float) -> tuple[float, float]:
        """Return the speed in steps per second, and the seconds left, after a step that was finished at time `now`."""
        since, taken = (self.warm, self.warm_step) if event.step > self.warm_step else (self.start, self.first)
        done = event.share_done
        # Before the pace is measured, the work so far is assumed to be in proportion to the steps.
        done_before = done * taken / event.step if self._warm_share is None else self._warm_share
        elapsed = max(now - since, 1e-9)
        if event.step - self.first <= COMPILATION_STEPS:
            self.warm, self.warm_step, self._warm_share = now, event.step, done
        seconds_left = (1 - done) * elapsed / max(done - done_before, 1e-9)
        return max(event.step - taken, 1) / elapsed, seconds_left


class SharePace:
    """Measures how fast the completed share of some work grows, over the last half of its time."""

    def __init__(self, start: float) -> None:
        """Begin at time `start`, in seconds."""
        self.start = start
        self._samples: list[tuple[float, float]] = []  # (time, share)

    def add(self, share: float, now: float) -> None:
        """Add the share, 0 to 1, that is completed at time `now`."""
        interval = max(MIN_SAMPLE_INTERVAL_SECONDS, (now - self.start) / MAX_SAMPLES)
        if share > 0 and (not self._samples or now - self._samples[-1][0] >= interval):
            self._samples.append((now, share))

    def at(self, share: float, now: float) -> float | None:
        """Return the shares per second until `share` at time `now`; None if too little is done."""
        middle = now - (now - self.start) / 2
        samples = self._samples or [(now, share)]
        since, first = next((sample for sample in reversed(samples) if sample[0] <= middle), samples[0])
        elapsed, done = now - since, share - first
        return done / elapsed if done >= MIN_PACE_SHARE and elapsed >= MIN_PACE_SECONDS else None

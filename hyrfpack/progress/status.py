"""The latest state of long work, as one line: a training step, a task or a stage, with elapsed and remaining time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from time import monotonic

from hyrfpack.counts import format_count
from hyrfpack.measure.psnr import psnr_from_mse
from hyrfpack.progress.events import Event, StageEvent, StepEvent, TaskEvent
from hyrfpack.progress.pace import SharePace, StepPace

RUNNING_MEAN_WEIGHT = 0.05  # The newest step has this weight in the running means of loss and squared error.
# The remaining time of a task's items is shown if it and the elapsed time are at least this long.
MIN_ETA_SECONDS = 1.0
OVERDUE_TIME_RATIO = 0.25  # Overdue work is expected to take this ratio of its elapsed time in addition.
PART_SEPARATOR = " | "
# Parts of a step that are left out on a narrow terminal, the least important ones first.
OPTIONAL_STEP_PARTS = ("gaussians", "loss", "elapsed", "speed", "psnr", "eta")


@dataclass(frozen=True)
class StatusLine:
    """One line of progress.

    Attributes:
        parts: texts of the line by name, in reading order.
        share: share of the work that is done, 0 to 1.
        optional: names of the parts to leave out if the line is too long, the first ones first.
    """

    parts: dict[str, str]
    share: float
    optional: Sequence[str]

    def __str__(self) -> str:
        return PART_SEPARATOR.join(self.parts.values())


class StepMeans:
    """Running means over the steps of a training run.

    Attributes:
        loss, mse: means of the loss and of the mean squared error; None before the first step that has an error. Steps
            whose photo is masked completely do not count.
    """

    def __init__(self) -> None:
        self.loss: float | None = None
        self.mse: float | None = None

    def add(self, event: StepEvent) -> None:
        """Add a step."""
        if not math.isnan(event.mse):
            weight = RUNNING_MEAN_WEIGHT if self.loss is not None else 1.0
            self.loss = event.loss * weight + (self.loss or 0) * (1 - weight)
            self.mse = event.mse * weight + (self.mse or 0) * (1 - weight)


class Status:
    """Turns the events of some work into one line, which is up to date at any time.

    Steps that follow other events are those of a new run, whose time began with the last task. A task's elapsed time is
    that of the task, or that of the whole work if the event has the share of the whole.

    Attributes:
        title: name of the work, which begins the line of a task; "" for none.
        start: time of the monotonic clock, in seconds, at which the work began.
        event: the latest event; None before the first.
        task_start: time at which the latest task, stage or run of steps began.
        means: running means of the latest run of steps.
    """

    def __init__(self, title: str = "") -> None:
        self.title = title
        self.start = self.task_start = self._time = monotonic()
        self.event: Event | None = None
        self.means = StepMeans()
        self._share_pace = SharePace(self.start)
        self._step_pace = StepPace(0, self.start)
        self._speed = self._seconds_left = 0.0

    def update(self, event: Event) -> None:
        """Take the next event."""
        now = monotonic()
        if isinstance(event, StepEvent):
            if not isinstance(self.event, StepEvent):
                self.means, self._step_pace = StepMeans(), StepPace(event.step - 1, self.task_start)
            self.means.add(event)
            self._speed, self._seconds_left = self._step_pace.at(event, now)
        elif isinstance(event, TaskEvent):
            if not (isinstance(self.event, TaskEvent) and self.event.task == event.task):
                self.task_start = now
            if event.share is not None:
                self._share_pace.add(event.share, now)
        self.event, self._time = event, now

    def line(self) -> StatusLine | None:
        """Return the current line; None if there is nothing to show."""
        now, event = monotonic(), self.event
        if isinstance(event, StepEvent):
            return self._step_line(event, now)
        if isinstance(event, StageEvent):
            number = f"{event.number}/{event.count} " if event.count > 1 else ""
            left = None if event.seconds_left is None else self._count_down(event.seconds_left, now)
            return _work_line([f"{number}{event.stage}", *event.details], event.share, now - self.start, left)
        if isinstance(event, TaskEvent):
            return self._task_line(event, now)
        return None

    def _step_line(self, event: StepEvent, now: float) -> StatusLine | None:
        """Return the line of a step; None if no step so far has an error."""
        if self.means.loss is None or self.means.mse is None:
            return None
        parts = {
            "steps": f"step {event.step}/{event.steps}",
            "loss": f"loss {self.means.loss:.3f}",
            "psnr": format_psnr(self.means.mse),
            "gaussians": format_count(event.gaussians, "Gaussian"),
            "speed": format_speed(self._speed),
            "elapsed": format_elapsed(self._time - self.task_start),
            "eta": format_eta(self._seconds_left),
        }
        if event.step == event.steps:
            del parts["eta"]
        return StatusLine(parts, event.share_done, OPTIONAL_STEP_PARTS)

    def _task_line(self, event: TaskEvent, now: float) -> StatusLine:
        texts = [self.title] * bool(self.title) + [event.task]
        if event.total:
            elapsed = now - self.task_start
            remaining = elapsed * (event.total - event.done) / event.done if event.done else 0.0
            left = remaining if min(elapsed, remaining) >= MIN_ETA_SECONDS else None
            return _work_line([*texts, f"{event.done}/{event.total}"], event.done / event.total, elapsed, left)
        if event.share is None:
            return _work_line(texts, 0.0, now - self.task_start, None)
        pace = self._share_pace.at(event.share, self._time)
        left = None if pace is None else self._count_down((1 - event.share) / pace, now)
        return _work_line(texts, event.share, now - self.start, left)

    def _count_down(self, seconds_left: float, now: float) -> float:
        """Return the remaining seconds, which were `seconds_left` at the latest event; never less than one."""
        since = now - self._time
        return max(seconds_left - since, OVERDUE_TIME_RATIO * since, 1.0)


def _work_line(texts: Sequence[str], share: float, elapsed: float, left: float | None) -> StatusLine:
    """Return the line of a task or a stage; `texts` are its descriptions, the most important first."""
    parts = {f"text {number}": text for number, text in enumerate(texts)}
    parts["elapsed"] = format_elapsed(elapsed)
    optional = [*reversed(parts)][:-1]
    if left is not None:
        parts["eta"] = format_eta(left)
    return StatusLine(parts, share, [*optional, "eta"])


def format_duration(seconds: float) -> str:
    """Format a duration as minutes and seconds, "0:15", or from one hour on with hours, "1:04:09"."""
    minutes, seconds = divmod(round(seconds), 60)
    return f"{minutes}:{seconds:02}" if minutes < 60 else f"{minutes // 60}:{minutes % 60:02}:{seconds:02}"


def format_elapsed(seconds: float) -> str:
    """Format the elapsed time for a progress line."""
    return f"elapsed {format_duration(seconds)}"


def format_eta(seconds: float) -> str:
    """Format the estimated remaining time for a progress line."""
    return f"ETA {format_duration(seconds)}"


def format_psnr(mse: float) -> str:
    """Format the PSNR of a mean squared error for a progress line."""
    return f"PSNR {psnr_from_mse(mse):.1f} dB"


def format_speed(steps_per_second: float) -> str:
    """Format a speed as iterations per second, or as seconds per iteration if it is below one.

    Example:
        >>> format_speed(40.2), format_speed(2.5), format_speed(0.5)
        ('40 it/s', '2.5 it/s', '2.0 s/it')
    """
    if steps_per_second < 1:
        return f"{1 / steps_per_second:.1f} s/it"
    return f"{steps_per_second:.{0 if steps_per_second >= 10 else 1}f} it/s"

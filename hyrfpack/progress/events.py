"""Events that long work reports, and functions that report parts of it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from threading import Lock
from typing import TypeVar

S = TypeVar("S")
T = TypeVar("T")

# If the number of rounds is unknown, each round is assumed to do this share of the remaining work.
REMAINING_SHARE_PER_ROUND = 0.4


@dataclass(frozen=True)
class StepEvent:
    """A finished step of a training run.

    Attributes:
        step, steps: number of the step, from 1, and of all steps of the run.
        loss: loss of the step's view.
        mse: mean squared error of the view's colours in [0, 1]; NaN if all of its photo is masked.
        gaussians: number of Gaussians of the model.
        share: estimated share of the run's work that is done, 0 to 1; None if all steps take equally long.
    """

    step: int
    steps: int
    loss: float
    mse: float
    gaussians: int
    share: float | None = None

    @property
    def share_done(self) -> float:
        """Return the share of the run's work that is done, 0 to 1."""
        return self.step / self.steps if self.share is None else self.share


@dataclass(frozen=True)
class TaskEvent:
    """Progress of work other than training steps.

    Attributes:
        task: description of the current task, such as "scoring held-out photos".
        share: completed share of the whole work, 0 to 1; None if it is unknown.
        done, total: number of items of the task that are done, and of all its items; a total of 0 if it is unknown.
    """

    task: str
    share: float | None = None
    done: int = 0
    total: int = 0

    def __str__(self) -> str:
        return f"{self.task} {self.done}/{self.total}" if self.total else self.task


@dataclass(frozen=True)
class StageEvent:
    """Progress of a pipeline, such as `hyrfpack.make_scene`.

    Attributes:
        stage: "poses", "measurement", "training", "compression", "export", "scoring" or "import".
        number, count: number of the stage, from 1, and of all stages.
        share: completed share of the stage, 0 to 1; 0 if it is unknown.
        seconds_left: estimated seconds until all stages are done; None if there is no estimate yet.
        details: descriptions of the current work, the most important first.
    """

    stage: str
    number: int
    count: int
    share: float
    seconds_left: float | None
    details: tuple[str, ...] = ()


Event = StepEvent | TaskEvent | StageEvent
Progress = Callable[[Event], None]


def ignore_progress(event: Event) -> None:
    """Ignore an event, for work whose progress nobody follows."""


def part_of_progress(progress: Progress, start: float, end: float) -> Progress:
    """Return a progress function for a part of the work.

    It maps the shares 0 to 1 of tasks to `start` to `end` of the whole.

    Example:
        >>> part_of_progress(lambda event: print(event.share), 0.5, 1.0)(TaskEvent("measuring", 0.5))
        0.75
    """

    def report(event: Event) -> None:
        if isinstance(event, TaskEvent) and event.share is not None:
            event = dataclasses.replace(event, share=start + (end - start) * event.share)
        progress(event)

    return report


def round_of_progress(progress: Progress, number: int) -> Progress:
    """Return a progress function for one round of work that takes an unknown number of rounds.

    Each round is assumed to do REMAINING_SHARE_PER_ROUND of the remaining work, so that the share of the whole grows
    and never reaches 1.

    Args:
        progress: progress function of the whole work.
        number: the number of the round, from 0.
    """
    return part_of_progress(
        progress, *(1 - (1 - REMAINING_SHARE_PER_ROUND) ** rounds for rounds in (number, number + 1))
    )


def items_of_progress(progress: Progress, task: str, count: int) -> Progress:
    """Return a progress function for one task, which reports shares as numbers of `count` items.

    Example:
        >>> items_of_progress(print, "scoring held-out photos", 20)(TaskEvent("scoring", 0.25))
        scoring held-out photos 5/20
    """

    def report(event: Event) -> None:
        if isinstance(event, TaskEvent) and event.share is not None:
            progress(TaskEvent(task, done=round(event.share * count), total=count))

    return report


def count_calls(function: Callable[[S], T], progress: Progress, task: str, count: int) -> Callable[[S], T]:
    """Return a function that does the same as `function` and reports after each of `count` calls, from any thread."""
    lock, done = Lock(), 0

    def call_and_report(item: S) -> T:
        nonlocal done
        result = function(item)
        with lock:
            done += 1
            progress(TaskEvent(task, done / count))
        return result

    return call_and_report

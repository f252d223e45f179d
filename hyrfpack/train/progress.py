"""The live line of a training run, and of what comes before its first and after its last step."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from contextlib import suppress
from threading import Event, Thread
from time import monotonic

from rich.console import Console, ConsoleOptions, RenderableType, RenderResult
from rich.live import Live
from rich.text import Text

from hyrfpack.evaluate.metrics import psnr_from_mse

SMOOTHING = 0.05  # weight of the newest step in the running means
LOG_EVERY = 15.0  # seconds between lines when standard error is not a terminal
FIRST_PHASE_LOG_SECONDS = 2.0  # a phase that takes longer than this gets a line there
MIN_ETA_SECONDS = 1.0  # a phase shows no remaining time below this, nor before it has taken as long
COLD_STEPS = 2  # in which kernels are compiled: they say nothing of the speed
FAIR_STEPS, FAIR_SECONDS = 3, 10.0  # from which on the speed is known well enough to speak of hours
LONG = 3600.0  # seconds left, from which on it is told what would make them fewer
BAR = 8, 24  # columns, at least and at most
DROPPED = ("gaussians", "loss", "gone", "speed", "psnr", "left")  # where a terminal is narrow, the first ones first


class Pace:
    """How fast steps are taken, by what was measured since the kernels are compiled.

    Attributes:
        warm, warm_step: when that was, and after which step.
    """

    def __init__(self, steps: int, done: int) -> None:
        self.steps, self.first, self.warm_step = steps, done, done
        self.start = self.warm = monotonic()

    def at(self, step: int, now: float) -> tuple[float, float]:
        """Steps a second and seconds left after this step, taken `now`."""
        since, taken = (self.warm, self.warm_step) if step > self.warm_step else (self.start, self.first)
        speed = max(step - taken, 1) / max(now - since, 1e-9)
        if step - self.first <= COLD_STEPS:
            self.warm, self.warm_step = now, step
        return speed, (self.steps - step) / speed


class ProgressLine:
    """Shows step, steps/s, loss, PSNR, Gaussians and time left on standard error.

    On a terminal one line that is redrawn and always fits; elsewhere (a log file) a plain line every few seconds.
    Where there is no standard error, nothing; and one that goes away does not end the training.
    """

    def __init__(self, steps: int, done: int, quiet: bool = False, advice: str = "") -> None:
        """Args: quiet: show nothing; advice: what would shorten the run ("fewer --steps or a GPU"), told once where
        more than an hour is left; without it, nothing is."""
        self.steps = steps
        self.start = self.last_log = monotonic()
        self.pace = Pace(steps, done)
        self.loss: float | None = None
        self.mse: float | None = None
        self.quiet = quiet or sys.stderr is None
        self.advice = advice
        self.line = StatusLine({"steps": f"{done:,}/{steps:,}", "left": "preparing the first step"}, done / steps)
        self.live = None if self.quiet else _live_on_terminal(self.line)

    def __enter__(self) -> ProgressLine:
        if self.live:
            with suppress(OSError, ValueError):
                self.live.start(refresh=True)
        return self

    def __exit__(self, *_: object) -> None:
        if self.live:
            with suppress(OSError, ValueError):
                self.live.stop()

    def note(self, sentence: str) -> None:
        """Tell the person something between the steps."""
        if self.live:
            with suppress(OSError, ValueError):
                self.live.console.print(sentence, markup=False, highlight=False)
        elif not self.quiet:
            _print(sentence)

    def update(self, step: int, loss: float, mse: float, gaussians: int) -> None:
        """Take in one finished step."""
        if not math.isnan(mse):
            weight = SMOOTHING if self.loss is not None else 1.0
            self.loss = loss * weight + (self.loss or 0) * (1 - weight)
            self.mse = mse * weight + (self.mse or 0) * (1 - weight)
        now = monotonic()
        speed, left = self.pace.at(step, now)
        if self.quiet or self.loss is None or self.mse is None:
            return
        self._advise(step, now, left)
        due = self.live is not None or now - self.last_log >= LOG_EVERY or step == self.steps
        if not due:
            return
        parts = {
            "steps": f"{step:,}/{self.steps:,}",
            "speed": f"{speed:.1f} steps/s" if speed >= 1 else f"{1 / speed:.1f} s/step",
            "loss": f"loss {self.loss:.4f}",
            "psnr": f"PSNR {psnr_from_mse(self.mse):.2f}",
            "gaussians": f"{gaussians:,} Gaussians",
            "gone": f"{duration(now - self.start)} gone",
            "left": f"{duration(left)} left",
        }
        if step == self.steps:
            del parts["left"]
        if self.live:
            self.line.parts, self.line.share = parts, step / self.steps
        else:
            self.last_log = now
            _print("step " + "  ".join(parts.values()))

    def _advise(self, step: int, now: float, left: float) -> None:
        fair = step - self.pace.warm_step >= FAIR_STEPS and now - self.pace.warm >= FAIR_SECONDS
        if self.advice and fair and left > LONG:
            self.note(f"this takes {left / 3600:.1f} more hours; {self.advice} would shorten it")
            self.advice = ""


class PhaseLine:
    """Shows work other than training steps on standard error: what is done, how far it is, and the time gone and left.

    On a terminal one line, which is removed at the end; elsewhere a plain line where a phase takes longer, and then
    every few seconds. The clock runs on between two updates. Where there is no standard error, nothing.
    """

    def __init__(self, quiet: bool = False) -> None:
        """Args: quiet: show nothing."""
        self.quiet = quiet or sys.stderr is None
        self.what, self.done, self.total = "", 0, 0
        self.start = monotonic()
        self.live = None if self.quiet else _live_on_terminal(self, transient=True)
        self._over = Event()
        self._logger = Thread(target=self._log, daemon=True)

    def __enter__(self) -> PhaseLine:
        if self.live:
            with suppress(OSError, ValueError):
                self.live.start(refresh=True)
        elif not self.quiet:
            self._logger.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        if self.live:
            with suppress(OSError, ValueError):
                self.live.stop()
        elif not self.quiet:
            self._logger.join()

    def note(self, sentence: str) -> None:
        """Tell the person something that stays."""
        if self.live:
            with suppress(OSError, ValueError):
                self.live.console.print(sentence, markup=False, highlight=False)
        elif not self.quiet:
            _print(sentence)

    def update(self, what: str, done: int, total: int) -> None:
        """Take in how far the work is.

        Args:
            what: is done; a new text begins a new phase.
            done, total: items of it; a total of 0 says that nobody knows.
        """
        if what != self.what:
            self.start = monotonic()
        self.what, self.done, self.total = what, done, total

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        if parts := self.parts(monotonic()):
            yield StatusLine(parts, self.done / self.total if self.total else 0.0, ("gone", "left", "count"))

    def parts(self, now: float) -> dict[str, str]:
        """What is known at a time of the monotonic clock, by name in the order of reading."""
        if not self.what:
            return {}
        gone = now - self.start
        parts = {"what": self.what}
        if self.total:
            parts["count"] = f"{self.done:,}/{self.total:,}"
        parts["gone"] = f"{duration(gone)} gone"
        left = gone * (self.total - self.done) / self.done if self.done else 0.0
        if min(gone, left) >= MIN_ETA_SECONDS:
            parts["left"] = f"{duration(left)} left"
        return parts

    def _log(self) -> None:
        """Print a line where one is due, until it is over."""
        printed: tuple[float, float] = (-1.0, 0.0)  # the start of the phase that the last line was about, and when
        while not self._over.wait(0.25):
            now, start = monotonic(), self.start
            due = FIRST_PHASE_LOG_SECONDS <= now - start if printed[0] != start else now - printed[1] >= LOG_EVERY
            if due and (parts := self.parts(now)):
                printed = start, now
                _print("  ".join(parts.values()))


def duration(seconds: float) -> str:
    """Of 120 seconds and less as "60 s", of more as hours, minutes and seconds: "1:04:09"."""
    whole = round(seconds)
    if whole <= 120:
        return f"{whole} s"
    return f"{whole // 3600}:{whole // 60 % 60:02}:{whole % 60:02}"


class StatusLine:
    """What is known of long work, as one line of any terminal's width.

    Attributes:
        parts: by name, in the order of reading; those that have no room are left out in the order of `dropped`.
        share: of the run that is done, drawn as a bar where there is room for one.
    """

    def __init__(self, parts: dict[str, str], share: float, dropped: Sequence[str] = DROPPED) -> None:
        self.parts, self.share, self.dropped = parts, share, dropped

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        words, width = dict(self.parts), options.max_width
        for name in self.dropped:
            if len("  ".join(words.values())) > width:
                words.pop(name, None)
        steps, *others = words.values()
        line = Text(steps, no_wrap=True, overflow="crop")
        room = min(width - len("  ".join(words.values())) - 2, BAR[1])
        if room >= BAR[0]:
            done, mark = round(self.share * room), "-" if options.ascii_only else "\u2501"
            line.append("  ").append(mark * done, "bar.complete").append(mark * (room - done), "bar.back")
        yield line.append("".join(f"  {word}" for word in others))


def _live_on_terminal(line: RenderableType, transient: bool = False) -> Live | None:
    """A display that redraws a line on standard error; None where that is no terminal that can."""
    if not sys.stderr.isatty():
        return None
    console = Console(stderr=True)
    return None if console.is_dumb_terminal else Live(line, console=console, refresh_per_second=4, transient=transient)


def _print(line: str) -> None:
    with suppress(OSError, ValueError):  # a log file on a full disk or a closed one does not end the training
        print(line, file=sys.stderr, flush=True)

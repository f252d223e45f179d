"""The progress lines of a training run, and of the work before its first and after its last step."""

from __future__ import annotations

import logging
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

_LOG = logging.getLogger(__name__)

RUNNING_MEAN_WEIGHT = 0.05  # The newest step has this weight in the running means of loss and squared error.
# If standard error is not a terminal, lines are printed at this interval. A phase gets its first line once it takes
# longer than FIRST_PHASE_LOG_SECONDS.
LOG_INTERVAL_SECONDS = 15.0
FIRST_PHASE_LOG_SECONDS = 2.0
MIN_ETA_SECONDS = 1.0  # A phase shows the remaining time only if this and the elapsed time are at least this long.
COMPILATION_STEPS = 2  # The first steps compile kernels, so they do not count for the speed.
# Advice to shorten the run is logged if at least this much time is left. Before that, the speed must have been measured
# over at least this many steps and seconds.
MIN_ADVICE_STEPS = 3
MIN_ADVICE_SECONDS = 10.0
MIN_ADVICE_SECONDS_LEFT = 3600.0
MIN_BAR_COLUMNS, MAX_BAR_COLUMNS = 8, 24
PART_SEPARATOR = " | "
# Parts that are left out on a narrow terminal, the least important ones first.
OPTIONAL_PARTS = ("gaussians", "loss", "elapsed", "speed", "psnr", "eta")


class Pace:
    """Measures the speed of a run since its kernels were compiled.

    Attributes:
        warm: time of the monotonic clock, in seconds, at which all kernels were compiled.
        warm_step: the step after which all kernels were compiled.
    """

    def __init__(self, steps: int, done: int) -> None:
        self.steps, self.first, self.warm_step = steps, done, done
        self.start = self.warm = monotonic()

    def at(self, step: int, now: float) -> tuple[float, float]:
        """Return the speed in steps per second, and the seconds left, after a step that was finished at time `now`."""
        since, taken = (self.warm, self.warm_step) if step > self.warm_step else (self.start, self.first)
        speed = max(step - taken, 1) / max(now - since, 1e-9)
        if step - self.first <= COMPILATION_STEPS:
            self.warm, self.warm_step = now, step
        return speed, (self.steps - step) / speed


class ProgressLine:
    """Shows step, loss, PSNR, Gaussians, speed, elapsed time and estimated remaining time (ETA) on standard error.

    On a terminal, one line is redrawn that fits any width. Elsewhere, as in a log file, a plain line is printed every
    `LOG_INTERVAL_SECONDS`. What is printed to standard error meanwhile appears above the line. A missing or closed
    standard error does not end the training.
    """

    def __init__(self, steps: int, done: int, quiet: bool = False, advice: str = "") -> None:
        """Start at step `done` of `steps`.

        Args:
            quiet: show nothing.
            advice: how to shorten the run ("fewer steps or a GPU"), logged once if more than an hour remains.
        """
        self.steps = steps
        self.start = self.last_log = monotonic()
        self.pace = Pace(steps, done)
        self.loss: float | None = None
        self.mse: float | None = None
        self.quiet = quiet or sys.stderr is None
        self.advice = advice
        self.line = StatusLine({"steps": f"step {done}/{steps}", "eta": "preparing the first step"}, done / steps)
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

    def update(self, step: int, loss: float, mse: float, gaussians: int) -> None:
        """Show one finished step."""
        if not math.isnan(mse):
            weight = RUNNING_MEAN_WEIGHT if self.loss is not None else 1.0
            self.loss = loss * weight + (self.loss or 0) * (1 - weight)
            self.mse = mse * weight + (self.mse or 0) * (1 - weight)
        now = monotonic()
        speed, left = self.pace.at(step, now)
        if self.quiet or self.loss is None or self.mse is None:
            return
        self._advise(step, now, left)
        due = self.live is not None or now - self.last_log >= LOG_INTERVAL_SECONDS or step == self.steps
        if not due:
            return
        parts = {
            "steps": f"step {step}/{self.steps}",
            "loss": f"loss {self.loss:.3f}",
            "psnr": format_psnr(self.mse),
            "gaussians": f"{gaussians:,} Gaussians",
            "speed": format_speed(speed),
            "elapsed": format_elapsed(now - self.start),
            "eta": format_eta(left),
        }
        if step == self.steps:
            del parts["eta"]
        if self.live:
            self.line.parts, self.line.share = parts, step / self.steps
        else:
            self.last_log = now
            _print(PART_SEPARATOR.join(parts.values()))

    def _advise(self, step: int, now: float, left: float) -> None:
        steps, seconds = step - self.pace.warm_step, now - self.pace.warm
        is_speed_known = steps >= MIN_ADVICE_STEPS and seconds >= MIN_ADVICE_SECONDS
        if self.advice and is_speed_known and left > MIN_ADVICE_SECONDS_LEFT:
            _LOG.info(f"about {left / 3600:.1f} hours remain; to shorten the run, use {self.advice}")
            self.advice = ""


class PhaseLine:
    """Shows work other than training steps on standard error, with its progress, elapsed and remaining time.

    On a terminal, one line is redrawn, also between updates, and removed at the end. Elsewhere a plain line is printed
    once a phase takes longer than `FIRST_PHASE_LOG_SECONDS`, and then every `LOG_INTERVAL_SECONDS`. A missing or closed
    standard error is ignored.
    """

    def __init__(self, quiet: bool = False) -> None:
        """Start without a phase; `quiet` shows nothing."""
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

    def update(self, what: str, done: int, total: int) -> None:
        """Show progress.

        Args:
            what: name of the work; another name starts a new phase.
            done, total: number of items done and of all items; a total of 0 means that it is not known.
        """
        if what != self.what:
            self.start = monotonic()
        self.what, self.done, self.total = what, done, total

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        if parts := self.parts(monotonic()):
            yield StatusLine(parts, self.done / self.total if self.total else 0.0, ("elapsed", "eta", "count"))

    def parts(self, now: float) -> dict[str, str]:
        """Return the parts of the line at time `now` of the monotonic clock, by name in reading order."""
        if not self.what:
            return {}
        elapsed = now - self.start
        parts = {"what": self.what}
        if self.total:
            parts["count"] = f"{self.done}/{self.total}"
        parts["elapsed"] = format_elapsed(elapsed)
        left = elapsed * (self.total - self.done) / self.done if self.done else 0.0
        if min(elapsed, left) >= MIN_ETA_SECONDS:
            parts["eta"] = format_eta(left)
        return parts

    def _log(self) -> None:
        """Print lines when they are due, until `__exit__`."""
        printed: tuple[float, float] = (-1.0, 0.0)  # The start of the last line's phase, and the time of that line.
        while not self._over.wait(0.25):
            now, start = monotonic(), self.start
            due = (
                FIRST_PHASE_LOG_SECONDS <= now - start
                if printed[0] != start
                else now - printed[1] >= LOG_INTERVAL_SECONDS
            )
            if due and (parts := self.parts(now)):
                printed = start, now
                _print(PART_SEPARATOR.join(parts.values()))


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


class StatusLine:
    """The progress of long work as one line that fits any terminal width.

    Attributes:
        parts: texts of the line by name, in reading order.
        share: share of the work that is done, 0 to 1; shown as a bar if there is room for one.
        optional: names of the parts to leave out if the line is too long, the first ones first.
    """

    def __init__(self, parts: dict[str, str], share: float, optional: Sequence[str] = OPTIONAL_PARTS) -> None:
        self.parts, self.share, self.optional = parts, share, optional

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        words, width = dict(self.parts), options.max_width
        for name in self.optional:
            if len(PART_SEPARATOR.join(words.values())) > width:
                words.pop(name, None)
        steps, *others = words.values()
        line = Text(steps, no_wrap=True, overflow="crop")
        room = min(width - len(PART_SEPARATOR.join(words.values())) - 1, MAX_BAR_COLUMNS)
        if room >= MIN_BAR_COLUMNS:
            done, mark = round(self.share * room), "-" if options.ascii_only else "\u2501"
            line.append(" ").append(mark * done, "bar.complete").append(mark * (room - done), "bar.back")
        yield line.append("".join(f"{PART_SEPARATOR}{word}" for word in others))


def _live_on_terminal(line: RenderableType, transient: bool = False) -> Live | None:
    """Return a display that redraws a line on standard error; None if it is no terminal that supports this."""
    if not sys.stderr.isatty():
        return None
    console = Console(stderr=True)
    return None if console.is_dumb_terminal else Live(line, console=console, refresh_per_second=4, transient=transient)


def _print(line: str) -> None:
    with suppress(OSError, ValueError):  # A log file that is closed or on a full disk must not end the training.
        print(line, file=sys.stderr, flush=True)

"""The live line of a training run."""

from __future__ import annotations

import math
import sys
import time
from contextlib import suppress

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

SMOOTHING = 0.05  # weight of the newest step in the running means
LOG_EVERY = 15.0  # seconds between lines when standard error is not a terminal


class ProgressLine:
    """Shows step, steps/s, loss, PSNR, Gaussians and time left on standard error.

    On a terminal one line that is redrawn; elsewhere (a log file) a plain line every few seconds. `quiet` shows
    nothing.
    """

    def __init__(self, steps: int, done: int, quiet: bool = False) -> None:
        self.steps = steps
        self.first = done
        self.start = self.last_log = time.monotonic()
        self.loss = self.mse = None
        self.quiet = quiet
        self.bar: Progress | None = None
        if not quiet and sys.stderr.isatty():
            self.bar = Progress(
                TextColumn("{task.completed:,.0f}/{task.total:,.0f}"),
                BarColumn(bar_width=24),
                TextColumn("{task.fields[line]}"),
                TimeElapsedColumn(),
                TextColumn("left"),
                TimeRemainingColumn(),
                console=Console(stderr=True),
                refresh_per_second=4,
            )
            self.task = self.bar.add_task("train", total=steps, completed=done, line="")

    def __enter__(self) -> ProgressLine:
        if self.bar:
            self.bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self.bar:
            self.bar.stop()

    def note(self, sentence: str) -> None:
        """Tell the person something between the steps."""
        if self.bar:
            self.bar.console.print(sentence, markup=False, highlight=False)
        elif not self.quiet:
            _print(sentence)

    def update(self, step: int, loss: float, mse: float, gaussians: int) -> None:
        """Take in one finished step."""
        if not math.isnan(mse):
            weight = SMOOTHING if self.loss is not None else 1.0
            self.loss = loss * weight + (self.loss or 0) * (1 - weight)
            self.mse = mse * weight + (self.mse or 0) * (1 - weight)
        if self.quiet or self.loss is None:
            return
        now = time.monotonic()
        due = self.bar is not None or now - self.last_log >= LOG_EVERY or step == self.steps
        if not due:
            return
        rate = (step - self.first) / max(now - self.start, 1e-9)
        psnr = -10 * math.log10(max(self.mse, 1e-10))
        line = f"{rate:5.1f} steps/s  loss {self.loss:.4f}  PSNR {psnr:5.2f}  {gaussians:,} Gaussians"
        if self.bar:
            self.bar.update(self.task, completed=step, line=line)
        else:
            self.last_log = now
            left = (self.steps - step) / max(rate, 1e-9)
            _print(f"step {step:,}/{self.steps:,}  {line}  {left:.0f} s left")


def _print(line: str) -> None:
    with suppress(OSError):  # a log file on a full disk does not end the training
        print(line, file=sys.stderr, flush=True)

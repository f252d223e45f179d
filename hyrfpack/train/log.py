"""The machine-readable training log: one line of JSON per record, and TensorBoard scalars if that is installed."""

from __future__ import annotations

import json
import logging
import os
import sys
import time
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TextIO

import torch

from hyrfpack.atomic import describe_rename, numbered_names
from hyrfpack.errors import HyrfError
from hyrfpack.measure.psnr import psnr_from_mse
from hyrfpack.progress import StepEvent
from hyrfpack.progress.pace import StepPace
from hyrfpack.train.trainer import is_recorded

_LOG = logging.getLogger(__name__)

MAX_RECORD_INTERVAL_SECONDS = 10.0
SCALAR_NAMES = ("loss", "psnr", "gaussians", "steps_per_second", "memory_bytes", "gpu_memory_bytes")


class TrainingLog:
    """Writes the records of a run to a file, each one as soon as it is known.

    Each line is a JSON object with the key "event". Its value is "step" for a step, and "end" for the end of the run.
    Steps are recorded if `is_recorded` is true, or if the last record is `MAX_RECORD_INTERVAL_SECONDS` old. An "end"
    has "complete", whether the run is complete, and "error", the reason if it failed. A "step" has

        step, steps         steps taken, and steps of the whole run
        loss, psnr          means over the steps since the last record, psnr in dB; null if masks left no pixel
        gaussians           number of Gaussians of the model
        memory_bytes        peak memory of the process so far; null if the system does not report it
        gpu_memory_bytes    peak GPU memory of the process so far; null on a CPU
        steps_per_second    current speed
        seconds             time since training started or was resumed
        seconds_left        estimated remaining time

    If the file can no longer be written, as on a full disk, the log ends and the run continues.
    """

    def __init__(self, path: Path, steps: int, done: int, device: torch.device, overwrite: bool = True) -> None:
        """Start a log, or continue it if `done` steps of `steps` have been taken already.

        TensorBoard's files go to a folder beside the log with the suffix ".tensorboard". Without `overwrite`, a new log
        does not replace an existing file, but gets a free name beside it.

        Raises:
            HyrfError: the file cannot be written.
        """
        self.steps, self.device = steps, device
        self.start = self.last = time.monotonic()
        self.pace = StepPace(done, self.start)
        self.losses: list[float] = []
        self.errors: list[float] = []
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            if done or overwrite:
                self.file: TextIO = open(path, "a" if done else "w", encoding="utf-8")
            else:
                self.file = _open_new(path)
        except OSError as error:
            raise HyrfError(f"{path}: the log cannot be written ({error.strerror})", fix="name another file") from error
        self.path = Path(self.file.name)
        if self.path != path:
            _LOG.warning(describe_rename(path, self.path))
        self.scalars = _summary_writer(self.path)

    def step(self, event: StepEvent) -> None:
        """Add a finished step, and write a record if one is due."""
        now = time.monotonic()
        speed, left = self.pace.at(event, now)
        if event.mse == event.mse:  # The mean squared error is NaN if all of the photo is masked.
            self.losses.append(event.loss)
            self.errors.append(event.mse)
        if not (is_recorded(event.step, self.steps) or now - self.last >= MAX_RECORD_INTERVAL_SECONDS):
            return
        count = len(self.errors)
        record = {
            "event": "step",
            "step": event.step,
            "steps": self.steps,
            "loss": sum(self.losses) / count if count else None,
            "psnr": psnr_from_mse(sum(self.errors) / count) if count else None,
            "gaussians": event.gaussians,
            "memory_bytes": peak_memory(),
            "gpu_memory_bytes": torch.cuda.max_memory_allocated(self.device) if self.device.type == "cuda" else None,
            "steps_per_second": speed,
            "seconds": now - self.start,
            "seconds_left": left,
        }
        self.last = now
        self.losses.clear()
        self.errors.clear()
        self._write(record)
        if self.scalars is not None:
            for name in SCALAR_NAMES:
                if record[name] is not None:
                    self.scalars.add_scalar(f"train/{name}", record[name], event.step)

    def end(self, *, complete: bool, step: int, **facts: Any) -> None:
        """Write the last record: whether the run is complete, and facts about the result."""
        self._write({"event": "end", "complete": complete, "step": step, **facts})
        if self.scalars is not None:
            for name, value in facts.items():
                if isinstance(value, float):
                    self.scalars.add_scalar(f"held-out/{name}", value, step)

    def __enter__(self) -> TrainingLog:
        return self

    def __exit__(self, _kind: object, error: object, _traceback: object) -> None:
        if isinstance(error, HyrfError):
            self._write({"event": "end", "complete": False, "error": str(error)})
        with suppress(OSError):
            self.file.close()
        if self.scalars is not None:
            self.scalars.close()

    def _write(self, record: dict[str, Any]) -> None:
        if self.file.closed:
            return
        numbers = {name: _short(value) for name, value in record.items()}
        try:
            self.file.write(json.dumps(numbers, allow_nan=False) + "\n")
            self.file.flush()
        except OSError as error:
            _LOG.warning(f"{self.path}: the log cannot be written ({error.strerror}); training continues without it")
            with suppress(OSError):  # Closing tries to write the buffered bytes again.
                self.file.close()


def _open_new(path: Path) -> TextIO:
    """Open a new file under the first free name of `numbered_names`."""
    for name in numbered_names(path):
        with suppress(FileExistsError):
            return open(name, "x", encoding="utf-8")
    raise AssertionError("numbers never end")


def peak_memory() -> int | None:
    """Return the peak memory of this process in bytes; None if the system does not report it.

    Example:
        >>> peak_memory() is None or peak_memory() > 1_000_000
        True
    """
    if os.name != "posix":
        return None
    from resource import RUSAGE_SELF, getrusage

    return getrusage(RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def _short(value: Any) -> Any:
    """Round a float to six significant digits."""
    return float(f"{value:.6g}") if isinstance(value, float) else value


def _summary_writer(path: Path) -> Any:
    if find_spec("tensorboard") is None:
        return None
    from torch.utils.tensorboard import SummaryWriter

    return SummaryWriter(str(path.with_suffix(".tensorboard")))

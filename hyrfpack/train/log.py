"""The machine-readable training log: one line of JSON per record, and TensorBoard scalars if that is installed."""

from __future__ import annotations

import json
import logging
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TextIO

import torch

from hyrfpack.atomic import describe_rename, numbered_names
from hyrfpack.errors import HyrfError, printable
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

    If the file can no longer be written, as on a full disk, the log ends and the run continues. The same holds for
    TensorBoard's files and any error of TensorBoard.
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
                self.file: TextIO = _open_to_append(path) if done else open(path, "w", encoding="utf-8")
            else:
                self.file = _open_new(path)
        except OSError as error:
            raise HyrfError(
                f"{path}: the log cannot be written ({error.strerror})", fix="name another file with `log`"
            ) from error
        self.path = Path(self.file.name)
        if self.path != path:
            _LOG.warning(describe_rename(path, self.path))
        self.scalars: Any = None
        with self._scalars_dropped_on_error():
            self.scalars = _summary_writer(_scalars_folder(self.path), done)

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
        self._add_scalars("train", {name: record[name] for name in SCALAR_NAMES}, event.step)

    def end(self, *, complete: bool, step: int, **facts: Any) -> None:
        """Write the last record: whether the run is complete, and facts about the result."""
        self._write({"event": "end", "complete": complete, "step": step, **facts})
        scores = {name: value for name, value in facts.items() if isinstance(value, float)}
        self._add_scalars("held-out", scores, step)

    def __enter__(self) -> TrainingLog:
        return self

    def __exit__(self, _kind: object, error: object, _traceback: object) -> None:
        if isinstance(error, HyrfError):
            self._write({"event": "end", "complete": False, "error": str(error)})
        with suppress(OSError):
            self.file.close()
        with self._scalars_dropped_on_error():
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

    def _add_scalars(self, group: str, values: dict[str, Any], step: int) -> None:
        """Add TensorBoard scalars, named by group and name, if that is installed; values of None are left out."""
        with self._scalars_dropped_on_error():
            for name, value in values.items():
                if self.scalars is not None and value is not None:
                    self.scalars.add_scalar(f"{group}/{name}", value, step)

    @contextmanager
    def _scalars_dropped_on_error(self) -> Iterator[None]:
        """Turn an error of the block, which uses TensorBoard, into a warning, and write no scalars from then on."""
        try:
            yield
        except Exception as error:  # TensorBoard raises errors of many types, as on a full disk or a broken package.
            broken, self.scalars = self.scalars, None
            with suppress(Exception):  # it may be closing that failed
                if broken is not None:
                    broken.close()
            reason = printable(str(error) or type(error).__name__)
            _LOG.warning(
                f"{_scalars_folder(self.path)}: TensorBoard's files cannot be written ({reason}); training continues "
                "without them"
            )


def _open_to_append(path: Path) -> TextIO:
    """Open a log to append records. A last line that a kill or a full disk has cut off gets its end first."""
    is_cut_off = False
    with suppress(OSError):  # The file may be new, or empty, or not readable.
        if path.is_file():  # Reading a pipe would wait for its writer.
            with open(path, "rb") as earlier:
                earlier.seek(-1, os.SEEK_END)
                is_cut_off = earlier.read() != b"\n"
    file = open(path, "a", encoding="utf-8")
    if is_cut_off:
        file.write("\n")
    return file


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


def _scalars_folder(log: Path) -> Path:
    """Return the folder of TensorBoard's files beside a log."""
    return log.with_suffix(".tensorboard")


def _summary_writer(folder: Path, done: int) -> Any:
    """Return TensorBoard's writer, or None without TensorBoard; earlier scalars after step `done` no longer count."""
    if find_spec("tensorboard") is None:
        return None
    from torch.utils.tensorboard import SummaryWriter

    return SummaryWriter(str(folder), purge_step=done + 1)

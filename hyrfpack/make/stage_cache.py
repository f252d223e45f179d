"""Run the stages of a pipeline in a work folder, where their products are cached and resumed."""

from __future__ import annotations

import logging
import shutil
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from time import monotonic
from typing import Any

from hyrfpack.errors import HyrfError
from hyrfpack.make.progress import Reporter
from hyrfpack.make.state import WorkFolderState

_LOG = logging.getLogger(__name__)

# The file or folder that each stage writes into the work folder. It is removed before a stage runs again.
PRODUCT_NAMES = {
    "poses": "scene",
    "training": "run",
    "compression": "model.hyrf",
    "import": "model.hyrf",
    "export": "export",
}

MIN_RECORD_SECONDS = 15.0  # the time that a stage has taken so far is recorded at most this often


class Stopped(KeyboardInterrupt):
    """The work was interrupted by Ctrl-C, SIGTERM or the closing of its terminal; the same call resumes it.

    Attributes:
        stage: name of the interrupted stage, or of the latest one after which the call was interrupted.
        scene: file with the scene so far, a preview or the trained model; None if there is none.
    """

    def __init__(self, stage: str, scene: Path | None = None) -> None:
        super().__init__(f"stopped in {stage}")
        self.stage = stage
        self.scene = scene


class StageCache:
    """Runs stages, or reuses the products of stages that are finished with the same inputs.

    Attributes:
        folder: the work folder, which holds the products.
        state: the record of the work folder.
        reporter: reports progress.
        stage: name of the latest stage, also while it runs; "preparation" before the first one.
        kept: names of stages whose products were reused.
        seconds: time that each stage has taken in all calls together.
    """

    def __init__(
        self,
        folder: Path,
        reporter: Reporter,
        check_replacing: Callable[[WorkFolderState, str, dict[str, Any]], None],
    ) -> None:
        """Open the work folder.

        Args:
            folder: the work folder.
            reporter: reports progress.
            check_replacing: called with the record, the stage and its inputs before a stage runs; raises HyrfError to
                prevent it.
        """
        self.folder = folder
        self.state = WorkFolderState(folder)
        self.reporter = reporter
        self.stage = "preparation"
        self.kept: list[str] = []
        self.seconds: dict[str, float] = {}
        self._check_replacing = check_replacing

    def run_stage(
        self,
        name: str,
        inputs: dict[str, Any],
        execute: Callable[[bool], tuple[dict[str, Any], Sequence[str]]],
        fixed: dict[str, Any] | None = None,
    ) -> dict[str, Any]:
        """Run a stage, unless it is finished with the same inputs.

        Args:
            name: name of the stage.
            inputs: all plain values on which the product of the stage depends.
            execute: runs the stage. Its argument is whether an earlier call began the stage with the same inputs. It
                returns facts, which are plain values, and the files that it wrote, as paths relative to the folder.
            fixed: plain values that are recorded when the stage is begun, for `WorkFolderState.fixed`. Different values
                in a later call do not make the stage run again.

        Returns:
            The facts of the stage.

        Raises:
            Stopped: the stage was interrupted.
            HyrfError: the stage failed.
        """
        self.stage = name
        facts = self.state.facts(name, inputs)
        if facts is not None:
            self.kept.append(name)
            self.seconds[name] = self.state.seconds(name)
            self.reporter.skip(name, self.seconds[name])
            _LOG.info(f"{name}: reused from an earlier run ({self.seconds[name]:.0f} s)")
            return facts
        self._check_replacing(self.state, name, inputs)
        resuming = self.state.was_begun(name, inputs)
        if not resuming:
            if reasons := self.state.changed_inputs(name, inputs):
                _LOG.info(f"{name}: running again, because {' and '.join(reasons)} changed")
            if name in PRODUCT_NAMES:
                _remove_product(self.folder / PRODUCT_NAMES[name])
            self.state.begin(name, inputs, fixed or {})
        clock = _StageClock(self.state, name)
        try:
            with self.reporter.watched_by(clock.record):
                self.reporter.begin(name)
                facts, files = execute(resuming)
        except KeyboardInterrupt as error:
            with suppress(HyrfError):  # on a full disk, too, the user needs to see that the stage was stopped
                self.state.add_seconds(name, clock.unrecorded_seconds())
            raise Stopped(name, getattr(error, "scene", None)) from error
        except HyrfError as error:
            self._record_failure(name, clock)
            advice = f"{error.fix}{self._describe_kept_products(name)}"
            raise error.with_text(f"{name} failed: {error.problem}", advice) from error
        self.state.finish(name, files, facts, clock.unrecorded_seconds())
        self.seconds[name] = self.state.seconds(name)
        return facts

    def _record_failure(self, name: str, clock: _StageClock) -> None:
        """Record the time of a failed stage, or remove its record and its empty product if it wrote no file."""
        with suppress(HyrfError):  # the user needs to see the failure of the stage instead
            if self._has_product(name):
                self.state.add_seconds(name, clock.unrecorded_seconds())
            else:
                if name in PRODUCT_NAMES:
                    shutil.rmtree(self.folder / PRODUCT_NAMES[name], ignore_errors=True)
                self.state.forget(name)

    def _has_product(self, name: str) -> bool:
        """Return whether a stage has written a file, or files into a folder."""
        if name not in PRODUCT_NAMES:
            return False
        product = self.folder / PRODUCT_NAMES[name]
        return any(path.is_file() for path in product.rglob("*")) if product.is_dir() else product.exists()

    def _describe_kept_products(self, name: str) -> str:
        """Return the end of the message about a failed stage, which says where finished work is kept; "" if nowhere."""
        has_products = self._has_product(name) or self.state.has_finished
        return f"; finished work is kept in {self.folder}" if has_products else ""


class _StageClock:
    """Records the time of a running stage at intervals, so that a killed process loses little of it."""

    def __init__(self, state: WorkFolderState, stage: str) -> None:
        self._state, self._stage, self._since = state, stage, monotonic()

    def unrecorded_seconds(self) -> float:
        """Return the seconds since the last record, or since the stage began."""
        return monotonic() - self._since

    def record(self) -> None:
        """Record the time so far, unless the last record is less than MIN_RECORD_SECONDS old."""
        if self.unrecorded_seconds() >= MIN_RECORD_SECONDS:
            with suppress(HyrfError):  # a full disk ends the stage when its product is written, not here
                self._state.add_seconds(self._stage, self.unrecorded_seconds())
            self._since = monotonic()


def _remove_product(path: Path) -> None:
    """Remove the product of a stage."""
    try:
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)
    except OSError as error:
        raise HyrfError(
            f"{path}: the results of an earlier call cannot be deleted ({error.strerror})",
            fix="delete it yourself",
        ) from error


@contextmanager
def interruptible() -> Iterator[None]:
    """Let SIGTERM and SIGHUP raise KeyboardInterrupt in the block, unless the process was started to ignore them."""
    if threading.current_thread() is not threading.main_thread():  # only the main thread can set signal handlers
        yield
        return
    names = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
    previous = {number: signal.getsignal(number) for number in names}
    previous = {number: handler for number, handler in previous.items() if handler not in (signal.SIG_IGN, None)}

    def interrupt(number: int, frame: object) -> None:
        raise KeyboardInterrupt

    try:
        for number in previous:
            signal.signal(number, interrupt)
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)

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
        stage: name of the interrupted stage.
        preview: file with the scene as far as it is trained; None if there is none.
    """

    def __init__(self, stage: str, preview: Path | None = None) -> None:
        super().__init__(f"stopped in {stage}")
        self.stage = stage
        self.preview = preview


class StageCache:
    """Runs stages, or reuses the products of stages that are finished with the same inputs.

    Attributes:
        folder: the work folder, which holds the products.
        state: the record of the work folder.
        reporter: reports progress.
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
            self.state.add_seconds(name, clock.unrecorded_seconds())
            raise Stopped(name, getattr(error, "preview", None)) from error
        except HyrfError as error:
            kept = self._describe_kept_products(name, clock)
            raise error.with_text(f"{name} failed: {error.problem}", f"{error.fix}{kept}") from error
        self.state.finish(name, files, facts, clock.unrecorded_seconds())
        self.seconds[name] = self.state.seconds(name)
        return facts

    def _describe_kept_products(self, name: str, clock: _StageClock) -> str:
        """Return the end of the message about a failed stage; remove its record if it wrote nothing."""
        product = self.folder / PRODUCT_NAMES[name] if name in PRODUCT_NAMES else None
        has_product = product is not None and _has_files(product)
        try:
            if not has_product:
                self.state.forget(name)
            else:
                self.state.add_seconds(name, clock.unrecorded_seconds())
        except HyrfError:  # the user needs to see the failure of the stage instead
            pass
        return f"; what is finished is kept in {self.folder}" if has_product or self.state.has_finished else ""


class _StageClock:
    """Records the time of a running stage at intervals, so that a killed process loses little of it."""

    def __init__(self, state: WorkFolderState, stage: str) -> None:
        self._state, self._stage, self._since = state, stage, monotonic()

    def unrecorded_seconds(self) -> float:
        """Return the seconds since the last record, or since the stage began."""
        return monotonic() - self._since

    def record(self) -> None:
        """Record the time so far, unless the last record is younger than MIN_RECORD_SECONDS."""
        if self.unrecorded_seconds() >= MIN_RECORD_SECONDS:
            with suppress(HyrfError):  # a full disk ends the stage when its product is written, not here
                self._state.add_seconds(self._stage, self.unrecorded_seconds())
            self._since = monotonic()


def _has_files(product: Path) -> bool:
    """Return whether a product is a file or a folder with files; a folder without files is removed."""
    if product.is_dir():
        if any(path.is_file() for path in product.rglob("*")):
            return True
        shutil.rmtree(product, ignore_errors=True)
    return product.exists()


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
            fix="delete this path yourself",
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

"""A work folder, in which stages are done one after the other, kept, and gone on with."""

from __future__ import annotations

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
from hyrfpack.make.state import State

# What each stage leaves in the work folder; made anew, it goes first.
PRODUCTS = {
    "poses": "scene",
    "training": "run",
    "compression": "model.hyrf",
    "import": "model.hyrf",
    "export": "export",
}

MIN_RECORD_SECONDS = 15.0  # between two records of the time that a stage has taken so far

Say = Callable[[str], None]


class Stopped(KeyboardInterrupt):
    """The work was interrupted, by Ctrl-C, SIGTERM or a terminal that is closed; the same call goes on with it.

    Attributes:
        stage: in which.
    """

    def __init__(self, stage: str) -> None:
        super().__init__(f"stopped in {stage}")
        self.stage = stage


class Work:
    """Does stages, or takes those that are done from the same inputs.

    Attributes:
        folder: where products are kept.
        kept: stages that were found done.
        seconds: that each stage took, in all calls together.
    """

    def __init__(self, folder: Path, reporter: Reporter, say: Say, allow: Callable[[State], None]) -> None:
        """Args: allow: called before a stage is done, and raises HyrfError where nothing may be made anew."""
        self.folder = folder
        self.state = State(folder)
        self.reporter = reporter
        self.say = say
        self.kept: list[str] = []
        self.seconds: dict[str, float] = {}
        self._allow = allow

    def stage(
        self,
        name: str,
        inputs: dict[str, Any],
        act: Callable[[bool], tuple[dict[str, Any], Sequence[str]]],
        fixed: dict[str, Any] | None = None,
    ) -> dict[str, Any]:
        """Do a stage, unless it is done.

        Args:
            name: of the stage.
            inputs: plain values, all that decides what comes of it.
            act: does it; told whether it was begun before from the same inputs. Returns facts, plain values, and the
                files that it made, by their paths in the folder.
            fixed: plain values that are recorded when the stage is begun, for `State.fixed`. Other ones in a later
                call do not redo the stage.

        Returns:
            The facts.

        Raises:
            Stopped: it was interrupted.
            HyrfError: it cannot be done.
        """
        facts = self.state.facts(name, inputs)
        if facts is not None:
            self.kept.append(name)
            self.seconds[name] = self.state.seconds(name)
            self.reporter.skip(name, self.seconds[name])
            self.say(f"{name}: done before, in {self.seconds[name]:.0f} s")
            return facts
        self._allow(self.state)
        going_on = self.state.begun(name, inputs)
        if not going_on:
            if changed := self.state.changed(name, inputs):
                self.say(f"{name}: made anew, for {' and '.join(changed)} changed")
            if name in PRODUCTS:
                _remove(self.folder / PRODUCTS[name])
            self.state.begin(name, inputs, fixed or {})
        clock = _StageClock(self.state, name)
        try:
            with self.reporter.watched_by(clock.record):
                self.reporter.begin(name)
                facts, files = act(going_on)
        except KeyboardInterrupt as error:
            self.state.add_seconds(name, clock.unrecorded())
            raise Stopped(name) from error
        except HyrfError as error:
            raise type(error)(f"{name} failed: {error}{self._what_is_left(name, clock)}") from error
        self.state.finish(name, files, facts, clock.unrecorded())
        self.seconds[name] = self.state.seconds(name)
        return facts

    def _what_is_left(self, name: str, clock: _StageClock) -> str:
        """The end of the message about a stage that failed. Where the stage left nothing, its record is removed."""
        product = self.folder / PRODUCTS[name] if name in PRODUCTS else None
        has_product = product is not None and _has_content(product)
        try:
            if not has_product:
                self.state.forget(name)
            else:
                self.state.add_seconds(name, clock.unrecorded())
        except HyrfError:  # the failure of the stage is what the user needs to hear of
            pass
        return f"; what is finished is kept in {self.folder}" if has_product or self.state.has_finished else ""


class _StageClock:
    """Records the time that a stage takes while it works, so that a killed process loses little of it."""

    def __init__(self, state: State, stage: str) -> None:
        self._state, self._stage, self._since = state, stage, monotonic()

    def unrecorded(self) -> float:
        """Seconds since the last record, or since the stage began."""
        return monotonic() - self._since

    def record(self) -> None:
        """Write down the time so far, unless that was done a short while ago."""
        if self.unrecorded() >= MIN_RECORD_SECONDS:
            with suppress(HyrfError):  # a full disk ends the stage when its product is written, not here
                self._state.add_seconds(self._stage, self.unrecorded())
            self._since = monotonic()


def _has_content(product: Path) -> bool:
    """Whether a stage has left a file. A folder without files is removed."""
    if product.is_dir():
        if any(path.is_file() for path in product.rglob("*")):
            return True
        shutil.rmtree(product, ignore_errors=True)
    return product.exists()


def _remove(path: Path) -> None:
    """Remove a product of ours."""
    try:
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)
    except OSError as error:
        raise HyrfError(f"{path}: what an earlier call left cannot be removed ({error.strerror}); remove it") from error


@contextmanager
def interruptible() -> Iterator[None]:
    """SIGTERM and SIGHUP interrupt as Ctrl-C does, unless whoever started the program has them ignored."""
    if threading.current_thread() is not threading.main_thread():  # signals belong to the main thread
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

"""A work folder, in which stages are done one after the other, kept, and gone on with."""

from __future__ import annotations

import shutil
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
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
    ) -> dict[str, Any]:
        """Do a stage, unless it is done.

        Args:
            name: of the stage.
            inputs: plain values, all that decides what comes of it.
            act: does it; told whether it was begun before from the same inputs. Returns facts, plain values, and the
                files that it made, by their paths in the folder.

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
            self.say(f"{name}: done before, in {self.seconds[name]:.0f} s")
            return facts
        self._allow(self.state)
        going_on = self.state.begun(name, inputs)
        if not going_on:
            if changed := self.state.changed(name, inputs):
                self.say(f"{name}: made anew, for {' and '.join(changed)} changed")
            if name in PRODUCTS:
                _remove(self.folder / PRODUCTS[name])
            self.state.begin(name, inputs)
        began = monotonic()
        try:
            self.reporter.begin(name)
            facts, files = act(going_on)
        except KeyboardInterrupt as error:
            self.state.pause(name, monotonic() - began)
            raise Stopped(name) from error
        except HyrfError as error:
            raise type(error)(f"{name} failed: {error}; what is finished is kept in {self.folder}") from error
        self.state.finish(name, files, facts, monotonic() - began)
        self.seconds[name] = self.state.seconds(name)
        return facts


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

"""Live view: snapshots of a model in training, served to the page of the player."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from time import monotonic

from hyrfpack.errors import HyrfError
from hyrfpack.format import encode_model
from hyrfpack.scene import Scene
from hyrfpack.train import Trainer
from hyrfpack.train.provenance import training_provenance
from hyrfpack.web.player import encode_player
from hyrfpack.web.serve import MemoryFile, serve_in_thread

_LOG = logging.getLogger(__name__)

# File names under which the page fetches the snapshot and the progress.
SCENE_NAME = "scene.hyrf"
UPDATES_NAME = "training.json"
MIN_INTERVAL_SECONDS = 10.0
# The interval between snapshots is at least this many times as long as the last snapshot took, so that snapshots take
# at most 2.5 % of the time.
MIN_INTERVAL_RATIO = 40.0


class LiveView:
    """Observer that takes snapshots of the models of a training, its pilot and teacher runs, and a first look.

    A snapshot is a `.hyrf` file in memory with profile "raw", which is the fastest to write. Snapshots are taken after
    the very first step and the last step of a main run or first look, and in between at intervals of at least
    MIN_INTERVAL_SECONDS and MIN_INTERVAL_RATIO.
    The model is only read, so training with a live view gives the same model, bit by bit, as training without.

    Attributes:
        scene: the newest snapshot.
        updates: JSON with the number of the newest snapshot (0 if there is none), its step, the number of steps, and
            the kind of the run, see `Trainer`.

    Example:
        >>> view = LiveView()
        >>> trainer.run(progress=lambda event: view.observe(trainer))
    """

    def __init__(self, clock: Callable[[], float] = monotonic) -> None:
        """Create a view without a snapshot.

        Args:
            clock: returns the current time in seconds.
        """
        self.scene = MemoryFile(b"")
        self.updates = MemoryFile(_encode_progress(0, 0, 0, ""))
        self._clock = clock
        self._count = 0
        self._next = 0.0  # earliest time of the next snapshot, in seconds of the clock
        self._scene: Scene | None = None  # the scene of `_capture`; pilot runs have fewer photos than the main run
        self._capture: dict = {}

    def observe(self, trainer: Trainer) -> None:
        """Take a snapshot if one is due; called after each step.

        A model that cannot be written, such as one with non-finite numbers, is skipped: the trainer reports it.
        """
        started = self._clock()
        is_last = trainer.step == trainer.steps and trainer.kind in ("", "first look")
        if self._count and started < self._next and not is_last:
            return
        if trainer.scene is not self._scene:
            self._scene, self._capture = trainer.scene, training_provenance(trainer.scene)
        try:
            data = encode_model(trainer.model, "raw", {"steps": trainer.step, **self._capture})
        except HyrfError:
            return
        self._count += 1
        self.scene.replace(data)
        self.updates.replace(_encode_progress(self._count, trainer.step, trainer.steps, trainer.kind))
        now = self._clock()
        self._next = now + max(MIN_INTERVAL_SECONDS, MIN_INTERVAL_RATIO * (now - started))


@contextmanager
def live_view(title: str, *, port: int = 0) -> Iterator[LiveView]:
    """Serve a page that shows the training to browsers of this machine, until the block ends, and log its address.

    Args:
        title: title of the page.
        port: port to listen on, 0 to 65535; 0 takes a free one.

    Raises:
        HyrfError: the port cannot be used.

    Example:
        >>> with live_view("bonsai") as view:
        ...     hyrfpack.train_model(scene, "runs/bonsai", observer=view.observe)
    """
    view = LiveView()
    page = encode_player(title, content=SCENE_NAME, updates=UPDATES_NAME, fetches="'self'")
    with serve_in_thread(page, {SCENE_NAME: view.scene, UPDATES_NAME: view.updates}, port=port) as address:
        _LOG.info(f"watch the training at {address} until the command ends")
        yield view


def _encode_progress(snapshot: int, step: int, steps: int, kind: str) -> bytes:
    return json.dumps({"snapshot": snapshot, "step": step, "steps": steps, "kind": kind}).encode()

"""Snapshots of a model in training, served to the player's page."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from time import monotonic

from hyrfpack.cameras.capture import scene_provenance
from hyrfpack.errors import HyrfError
from hyrfpack.format import encode_model
from hyrfpack.train import Trainer
from hyrfpack.web.player import encode_player
from hyrfpack.web.serve import MemoryFile, serving

SCENE, UPDATES = "scene.hyrf", "training.json"  # names in the page's address
MIN_INTERVAL_SECONDS = 10.0  # between two snapshots
MIN_INTERVAL_RATIO = 40.0  # the same, in units of the time that the last snapshot took: it costs 2.5 % at most


class LiveView:
    """Takes snapshots of the model that a trainer trains; an observer of `hyrfpack.train.train`.

    A snapshot is a `.hyrf` file of profile raw in memory, the profile that takes the least time to write. The first
    step and the last one have one, and those between as far apart as MIN_INTERVAL_SECONDS and MIN_INTERVAL_RATIO say.
    The model is only read, so that a training with a view gives the same model, bit by bit, as one without.

    Attributes:
        scene: the newest snapshot.
        updates: JSON of its number (0 while there is none), its step, and the number of steps.

    Example:
        >>> view = LiveView()
        >>> trainer.run(report=lambda trainer, loss, mse: view.observe(trainer))
    """

    def __init__(self, clock: Callable[[], float] = monotonic) -> None:
        """Args: clock: gives seconds."""
        self.scene = MemoryFile(b"")
        self.updates = MemoryFile(_progress(0, 0, 0))
        self._clock = clock
        self._count = 0
        self._next = 0.0  # when the next snapshot may be taken, by the clock
        self._capture: dict | None = None

    def observe(self, trainer: Trainer) -> None:
        """Take a snapshot if one is due; called after each step.

        A model that cannot be written, as one whose numbers are not finite, is left out: the trainer speaks of that.
        """
        began = self._clock()
        if self._count and began < self._next and trainer.step < trainer.steps:
            return
        if self._capture is None:
            self._capture = scene_provenance(trainer.scene)
        try:
            data = encode_model(trainer.model, "raw", {"steps": trainer.step, **self._capture})
        except HyrfError:
            return
        self._count += 1
        self.scene.replace(data)
        self.updates.replace(_progress(self._count, trainer.step, trainer.steps))
        now = self._clock()
        self._next = now + max(MIN_INTERVAL_SECONDS, MIN_INTERVAL_RATIO * (now - began))


@contextmanager
def live_view(title: str, *, port: int = 0, say: Callable[[str], None]) -> Iterator[LiveView]:
    """Serve a page that shows a training to this machine, while the block runs.

    Args:
        title: of the page.
        port: to listen at, 0 to 65535; 0 takes a free one.
        say: called with a sentence that names the page's address.

    Raises:
        HyrfError: nothing can listen at this port.

    Example:
        >>> with live_view("bonsai", say=print) as view:
        ...     hyrfpack.train(scene, "runs/bonsai", observer=view.observe)
    """
    view = LiveView()
    page = encode_player(title, content=SCENE, updates=UPDATES, fetches="'self'")
    with serving(page, {SCENE: view.scene, UPDATES: view.updates}, port=port) as address:
        say(f"the training can be seen at {address} until the command ends")
        yield view


def _progress(snapshot: int, step: int, steps: int) -> bytes:
    return json.dumps({"snapshot": snapshot, "step": step, "steps": steps}).encode()

"""How a long call runs: its device and processes, and how its progress is shown and how it is stopped."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from hyrfpack.progress import Event, Progress, open_display

if TYPE_CHECKING:
    import torch

    from hyrfpack.data import PictureCache
    from hyrfpack.parallel.ranks import Ranks


@dataclass(frozen=True)
class RunContext:
    """Settings of how a long call runs, which do not change its result. Each long call takes one as `context`.

    Attributes:
        device: where to compute, see `hyrfpack.device.choose_device`. A call that needs no device ignores it. The
            result of `choose_device("cuda", self_test=False)` is a GPU without the self-test of its kernels.
        ranks: processes that work together, from `hyrfpack.parallel.ranks.join_processes`; None for this process alone.
            All of them make the same call, and only rank 0 writes, prints and logs.
        progress: "auto" shows a bar and curves in Jupyter, a line that is redrawn on a terminal, and plain lines on
            standard error elsewhere. None shows nothing. A function gets each event instead
            (`hyrfpack.progress.StepEvent`, `TaskEvent` or `StageEvent`), and each of several processes reports its own.
        cache: cache of decoded photos; None for one that takes a quarter of the memory.
        stop: asked during the work; once it returns True, the call ends as after Ctrl-C. `train_model` saves a
            checkpoint and returns; other calls raise KeyboardInterrupt.

    Example:
        >>> import hyrfpack
        >>> scene, config = hyrfpack.load_scene("photos/bonsai"), hyrfpack.TrainConfig(steps=3)
        >>> steps = []
        >>> context = hyrfpack.RunContext(device="cpu", progress=steps.append, stop=lambda: len(steps) > 5)
        >>> hyrfpack.train_model(scene, "runs/short", config, context=context).complete
        False
    """

    device: str | torch.device = "auto"
    ranks: Ranks | None = None
    progress: Progress | Literal["auto"] | None = "auto"
    cache: PictureCache | None = None
    stop: Callable[[], bool] | None = None

    def __post_init__(self) -> None:
        if not (self.progress in ("auto", None) or callable(self.progress)):
            raise ValueError(f"progress must be 'auto', None or a function, but is {self.progress!r}")

    def choose_device(self) -> torch.device:
        """Return the device of this process.

        Raises:
            HyrfError: there is no such device, or two processes would share a GPU.
        """
        from hyrfpack.device import choose_own_device
        from hyrfpack.parallel.ranks import SINGLE_PROCESS

        return choose_own_device(self.device, self.ranks or SINGLE_PROCESS)

    @property
    def is_shown(self) -> bool:
        """Return whether this process shows the progress itself."""
        return self.progress == "auto" and (self.ranks is None or self.ranks.is_main)

    @contextmanager
    def open_progress(self, title: str = "", *, interruptible: bool = True) -> Iterator[Progress]:
        """Show the progress of a call while the block runs, and yield the function that takes its events.

        Args:
            title: name of the work, which begins the lines of its tasks.
            interruptible: let that function raise KeyboardInterrupt if `stop` returns True. A call that asks `stop`
                itself, to end differently, sets it to False.
        """
        stop = self.stop if interruptible else None
        is_silent = self.progress == "auto" and not self.is_shown
        with open_display(None if is_silent else self.progress, title) as show:

            def report(event: Event) -> None:
                show(event)
                if stop is not None and stop():
                    raise KeyboardInterrupt

            yield report

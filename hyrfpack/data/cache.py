"""Decoded photos within a memory limit, and decoding ahead of need."""

from __future__ import annotations

import os
from collections import OrderedDict, deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import ThreadPoolExecutor
from itertools import islice
from pathlib import Path
from threading import Lock

from hyrfpack.scene import Picture, View


class PictureCache:
    """Keeps the pictures used last, up to a number of bytes. Safe to share between threads.

    Attributes:
        limit_bytes: the most it holds; a picture larger than that is decoded but not kept.
        nbytes: what it holds now.
    """

    def __init__(self, limit_bytes: int | None = None) -> None:
        """Args: limit_bytes: None takes a quarter of the memory this process may use."""
        self.limit_bytes = memory_bytes() // 4 if limit_bytes is None else limit_bytes
        self.nbytes = 0
        self._pictures: OrderedDict[Callable[[], Picture], Picture] = OrderedDict()
        self._lock = Lock()

    def get(self, view: View) -> Picture:
        """The view's picture, decoded if it is not at hand. Raises what `view.load` raises."""
        with self._lock:
            picture = self._pictures.get(view.load)
            if picture is not None:
                self._pictures.move_to_end(view.load)
                return picture
        # Decoded outside the lock: two threads may then decode the same photo, but none waits for another's.
        picture = view.load()
        with self._lock:
            if view.load not in self._pictures and picture.nbytes <= self.limit_bytes:
                self._pictures[view.load] = picture
                self.nbytes += picture.nbytes
                while self.nbytes > self.limit_bytes:
                    self.nbytes -= self._pictures.popitem(last=False)[1].nbytes
        return picture

    def stream(self, views: Iterable[View], depth: int = 4) -> Generator[tuple[View, Picture]]:
        """Yield each view with its picture, decoding up to `depth` of them ahead in one thread.

        Args:
            views: in the order they are needed, may be endless; pulled in the caller's thread, `depth` ahead.
            depth: pictures in flight, held beside the cache's limit.

        Raises:
            What `View.load` raises, when its turn comes. Leaving the loop or closing the iterator ends the thread.
        """
        upcoming = iter(views)
        with ThreadPoolExecutor(1, thread_name_prefix="hyrfpack-photos") as executor:
            pending = deque((view, executor.submit(self.get, view)) for view in islice(upcoming, depth))
            try:
                while pending:
                    view, future = pending.popleft()
                    picture = future.result()
                    pending.extend((view, executor.submit(self.get, view)) for view in islice(upcoming, 1))
                    yield view, picture
            finally:
                for _, future in pending:
                    future.cancel()


def memory_bytes() -> int:
    """Memory this process may use: the machine's, or its container's if that is less; 8 GiB where neither tells."""
    try:
        total = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):
        return 8 << 30
    try:
        limit = Path("/sys/fs/cgroup/memory.max").read_text().strip()
    except OSError:
        return total
    return min(total, int(limit)) if limit.isdigit() else total

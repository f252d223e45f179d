"""Cache decoded photos within a memory limit, and decode photos in advance."""

from __future__ import annotations

import os
from collections import OrderedDict, deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import ThreadPoolExecutor
from itertools import islice
from pathlib import Path
from threading import Lock
from typing import Any, TypeVar

from hyrfpack.scene import Picture, View

Owner = TypeVar("Owner")
Result = TypeVar("Result")

DEFAULT_PREFETCHED_PICTURES = 4


class PictureCache:
    """A cache of the most recently used pictures, limited in bytes. Threads may share it.

    Attributes:
        limit_bytes: size limit of the cache; a larger picture is decoded but not cached.
        nbytes: current size of the cache in bytes.
    """

    def __init__(self, limit_bytes: int | None = None) -> None:
        """Create an empty cache.

        Args:
            limit_bytes: size limit; None takes a quarter of the memory that this process may use.
        """
        self.limit_bytes = memory_bytes() // 4 if limit_bytes is None else limit_bytes
        self.nbytes = 0
        self._pictures: OrderedDict[Callable[[], Picture], Picture] = OrderedDict()
        self._lock = Lock()
        self._derived: tuple[Callable, object, Any] | None = None

    def get(self, view: View) -> Picture:
        """Return the view's picture, and decode it if it is not cached. Raises what `view.load` raises."""
        with self._lock:
            picture = self._pictures.get(view.load)
            if picture is not None:
                self._pictures.move_to_end(view.load)
                return picture
        # Decode outside the lock, so that no thread waits for another; two threads may decode the same photo.
        picture = view.load()
        with self._lock:
            if view.load not in self._pictures and picture.nbytes <= self.limit_bytes:
                self._pictures[view.load] = picture
                self.nbytes += picture.nbytes
                while self.nbytes > self.limit_bytes:
                    self.nbytes -= self._pictures.popitem(last=False)[1].nbytes
        return picture

    def derive(self, function: Callable[[Owner, PictureCache], Result], owner: Owner) -> Result:
        """Return `function(owner, self)`, and keep the result for another call with the same arguments.

        Only the last result is kept; its memory is not part of the limit. Threads may not share this method.

        Args:
            function: computes a result from pictures of the owner.
            owner: the object that the pictures belong to, such as a scene. It is compared by identity.
        """
        if self._derived is None or self._derived[0] is not function or self._derived[1] is not owner:
            self._derived = None  # frees its memory
            self._derived = (function, owner, function(owner, self))
        result: Result = self._derived[2]
        return result

    def clear(self) -> None:
        """Forget all pictures and the derived result, so that their memory is free for other work."""
        with self._lock:
            self._pictures.clear()
            self.nbytes = 0
        self._derived = None

    def stream(
        self, views: Iterable[View], depth: int = DEFAULT_PREFETCHED_PICTURES
    ) -> Generator[tuple[View, Picture]]:
        """Yield each view with its picture, while another thread decodes the next pictures.

        Leaving the loop or closing the iterator ends the thread.

        Args:
            views: views in the order of use; may be endless. The caller's thread takes them `depth` in advance.
            depth: number of pictures that are decoded in advance; their memory is not part of the cache's limit.

        Raises:
            What `View.load` raises, when the picture's turn comes.
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
    """Return the memory that this process may use: the machine's, or its container's limit if that is less.

    It is 8 GiB if neither is known.
    """
    try:
        total = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):
        return 8 << 30
    try:
        limit = Path("/sys/fs/cgroup/memory.max").read_text().strip()
    except OSError:
        return total
    return min(total, int(limit)) if limit.isdigit() else total
